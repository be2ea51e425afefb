"""Numerics: how one control step is taken.

``tracing``
    Runs a plain formula once on recording numbers and turns it into straight-line code.
``compiling``
    Compiles that code with Numba and keeps the result on disk.
``pendulum``
    The driven, damped pendulum (bar, cylinder in shell): Taylor series with a proved bound.
``slope``
    The rolling cylinder on a slope: closed form (fixed slope), linear flow (moving slope).
``primitives``
    What the compiled code calls: fused multiply-add, selection, the counter-based random generator.
"""
