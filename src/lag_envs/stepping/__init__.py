"""Numerics: how one control step is taken.

``tracing``
    Runs a plain formula once on recording numbers.
``primitives``
    Turns a record into compiled code; also holds the counter-based random generator.
``elementary``
    Sine, exponential and similar functions from plain arithmetic: the same bits on every machine.
``compiling``
    Compiles functions that call such blocks, and keeps the results on disk.
``pendulum``
    The driven, damped pendulum (bar, cylinder in shell): Taylor series with a proved bound.
``slope``
    The rolling cylinder on a slope: closed form (fixed slope), linear flow (moving slope).
``flows``
    Builds a scene's control step from one of these.
"""
