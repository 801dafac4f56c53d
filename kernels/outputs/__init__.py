"""Pictures on the device."""
