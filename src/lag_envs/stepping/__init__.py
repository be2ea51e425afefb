"""Numerics: how one control step is taken.

``tracing``
    Runs a plain formula once on recording numbers.
``primitives``
    Turns a record into compiled code; also the counter-based random generator.
``elementary``
    Sine, exponential and their like from plain arithmetic: the same bits on every machine.
``compiling``
    Compiles functions that call such blocks, and keeps the result on disk.
``pendulum``
    The driven, damped pendulum (bar, cylinder in shell): Taylor series with a proved bound.
``slope``
    The rolling cylinder on a slope: closed form (fixed slope), linear flow (moving slope).
``flows``
    Puts a scene's control step together from one of these.
"""
