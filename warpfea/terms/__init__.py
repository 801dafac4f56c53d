"""What adds to the residual of a step."""
