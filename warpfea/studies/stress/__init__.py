"""`warpfea stress`: stiff and extreme cases, each with a criterion that can fail."""
