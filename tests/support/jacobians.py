"""Numerical derivatives, to compare Jacobians with."""

import numpy as np


def numerical(function, pose=None, step=1e-6):
    """Derivative of a vector by six numbers, (N, 6), with central differences.

    The six numbers are the tangent vector at ``pose``; without a pose the function takes them.
    """
    at = pose.retract if pose is not None else np.asarray
    columns = [(function(at(d)) - function(at(-d))) / (2.0 * step) for d in step * np.eye(6)]
    return np.stack(columns, axis=1)
