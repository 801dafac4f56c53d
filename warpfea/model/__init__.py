"""Constant model data: bodies, surfaces, tables, topology."""
