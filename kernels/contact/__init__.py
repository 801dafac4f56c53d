"""Contact by stages. Points of a surface lie against an other side: rigid shapes ("colliders") or facets of bodies.

Broad phase: boxes of master facets (broad_phase.py), and of a mesh (collider_mesh.py).
Search: facet of a point (facet_search.py, facet_candidates.py, point_lists.py); edges that cross (edges.py); deepest
    position of a single-point contact (deepest_point.py); points of round parts that roll (rolling.py).
Projection: on a facet (projection.py); distance from a shape, and the side (colliders.py, collider_shapes.py); seams
    between shapes (collider_seams.py), between bodies, and of both (facet_seams.py).
Kinematics: own side of a point (kinematics.py), of obstacles that move (carriers.py); the geometry of the other side
    fills the record `PointContact` (structs.py): collider_kinematics.py, facet_kinematics.py.
Law: normal force (law.py); friction (friction.py).
Assembly: forces, products, blocks of any geometry (assembly.py).
Ledger: history, energies, records of any geometry (ledger.py).
Adjoint: laws (adjoint.py); the geometry of the other side (collider_adjoint.py, facet_adjoint.py).
At a state: evaluation.py. float32: double_displacements.py. Preconditioner: coupling.py, coarse_terms.py,
    rigid_modes.py. Setup: thickness.py, collider_sheets.py. Bodies without contact: crossings.py.

Recipes for a law, a rigid shape, a geometry of the other side: warpfea/README.md.
"""

from . import collider_kinematics, facet_kinematics

__all__ = ["collider_kinematics", "facet_kinematics"]
