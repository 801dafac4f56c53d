"""Studies made of many studies of error against run time."""
