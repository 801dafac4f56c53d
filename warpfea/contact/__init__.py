"""Contact: tables of points and facets, search of the other side, one term with two geometries."""

from ..terms.term_set import register
from .colliders import ColliderContact
from .facets import FacetContact

__all__ = ["ColliderContact", "FacetContact"]

register(ColliderContact, FacetContact)
