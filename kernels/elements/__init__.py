"""Elements and materials on the device."""
