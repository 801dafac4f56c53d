"""Elements and materials on the device: forces, tangent products, matrices, stresses."""
