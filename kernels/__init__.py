"""Device code of warpfea: wp.func and wp.kernel only. Imports nothing from the host side."""
