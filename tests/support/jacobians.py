"""Numerical derivatives, to compare Jacobians with."""

import numpy as np


def numerical(function, pose=None):
    """Derivative of a vector by six numbers, (N, 6), with central differences.

    The six numbers are the tangent vector at ``pose``; without a pose the function takes them.
    """
    at = pose.retract if pose is not None else np.asarray
    columns = [(function(at(d)) - function(at(-d))) / 2e-6 for d in 1e-6 * np.eye(6)]
    return np.stack(columns, axis=1)
