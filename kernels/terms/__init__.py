"""Forces that are not of elements: loads, followers, constraints."""
