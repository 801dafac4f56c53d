"""Forces besides those of elements: loads, follower loads, constraints."""
