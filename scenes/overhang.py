"""A heavy sheet overhangs a table, whose edge lies within its facets."""

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=1.0, tol=1e-6, fps=60.0, speed=0.5, picture=0.99)
def overhang(
    *,
    reach: float = 0.55,
    side: float = 0.1,
    width: float = 0.2,
    thickness: float = 1e-2,
    clipping: bool = True,
    E: float = 8e8,
    density: float = 1200.0,
) -> wf.ModelBuilder:
    """A sheet bends over the edge of a table, and rises from it behind.

    Without curvature where it lies again, the tip sinks by 0.24285 q a^4/(E I): overhang a, weight q per length.

    Args:
        reach: overhang, m.
        side: of a facet, m; by default the edge of the table is in the middle of one.
        width: of the sheet, m.
        thickness: of the sheet, m.
        clipping: the edge bears on the sheet within a facet, else the nearest points do.
        E: Young's modulus of the sheet (SVK, nu = 0), Pa.
        density: of the sheet, kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    material = wf.SVK(E=E, nu=0.0, density=density, damping=wf.KelvinVoigt(eta=0.02 * E))
    cells = (round(2.5 * reach / side + 0.5), max(1, round(width / side)))
    start = (reach - cells[0] * side, -0.5 * width, 0.5 * thickness)
    mesh = wf.mesh.grid((cells[0] * side, width), cells=cells, origin=start)
    sheet = b.add_shell(mesh, thickness=thickness, material=material, name="sheet")
    b.clamp(sheet.edge("x-"), slots="position", components="xy")
    table = b.add_collider(wf.Box((-1.5 * reach, 0.0, -0.1), (3.0 * reach, 2.0 * width, 0.2)), name="table")
    b.add_contact(sheet.surface("bottom"), table, clipping=clipping, name="lie")
    b.add_probe("tip", sheet.edge("x+"))
    return b
