"""Contact: tables of points and facets, search of the other side, one term with two geometries.

A law of one's own is an entry of `LAWS`; a geometry of the other side is a file, see warpfea/README.md.
"""

from ..kernels.contact.law import ANY_GAP, LAWS, ContactLaw
from ..terms.term_set import register
from .colliders import ColliderContact
from .facets import FacetContact

__all__ = ["ANY_GAP", "LAWS", "ColliderContact", "ContactLaw", "FacetContact"]

register(ColliderContact, FacetContact)
