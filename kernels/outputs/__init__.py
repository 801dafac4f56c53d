"""Pictures drawn on the device."""
