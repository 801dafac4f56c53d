"""Newton's method, conjugate gradients, preconditioners."""
