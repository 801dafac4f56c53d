"""Inverses of 3x3 diagonal blocks."""

import functools

import warp as wp

from .types import precision

__all__ = ["inverse_function"]


@functools.cache
def inverse_function(dtype: str):
    """The device function `free_inverse` in one precision: inverse of a 3x3 diagonal block on its free components.

    A block that is not safely positive definite is replaced by its diagonal, so that the inverse is always positive.
    """
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33

    @wp.func
    def positive_inverse(A: mat33, min_diagonal: T) -> mat33:
        """A^-1 if the leading minors of A are safely positive, else the inverse of |diag A|, at least `min_diagonal`.

        For A of order 1, whose minors neither overflow nor vanish.
        """
        d1 = A[0, 0]
        d2 = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
        d3 = wp.determinant(A)
        tol = T(1.0e-6)
        size = wp.trace(A)
        if d1 > tol * size and d2 > tol * size * size and d3 > tol * size * size * size * T(0.01):
            return wp.inverse(A)
        B = mat33()
        for k in range(3):
            B[k, k] = T(1.0) / wp.max(wp.abs(A[k, k]), wp.max(min_diagonal, tol * wp.abs(size)))
        return B

    @wp.func
    def free_inverse(A: mat33, min_diagonal: T, free: vec3) -> mat33:
        """Inverse of A on the components where `free` is 1; rows and columns of prescribed components are zero."""
        scale = T(1.0e-30)
        for i in range(3):
            scale = wp.max(scale, wp.abs(A[i, i]))
        s = T(1.0) / scale
        M = A
        for i in range(3):
            for j in range(3):
                M[i, j] = s * A[i, j] * free[i] * free[j]
            if free[i] == T(0.0):
                M[i, i] = wp.max(s * wp.abs(A[i, i]), T(1.0e-30))
        B = positive_inverse(M, s * min_diagonal)
        for i in range(3):
            for j in range(3):
                B[i, j] = s * B[i, j] * free[i] * free[j]
        return B

    return free_inverse
