"""Writers of results: USD, VTU, PNG, GIF."""
