"""Numerics: how a control step is taken and differentiated.

Recording
    ``tracing`` runs a formula once on numbers that record, ``elementary`` gives them sine, exponential and
    so on, ``adjoint`` differentiates a recording.
The general series
    ``lowering`` turns equations into a record of series, ``series`` writes their step once, with the
    ``certificate``; ``machine`` and ``script`` print it, ``driver`` divides a control step, ``backward``
    differentiates it, ``general`` puts a scene's step together, and ``lag`` does so for lagging motors.
Flows of their own
    ``normal_forms`` recognises them, ``pendulum`` and ``slope`` step them, ``flows`` makes a scene's step.
Machine code
    ``compiling`` and ``cache``; ``primitives`` prints recorded operations.
"""
