"""The USD of a real run, opened again: points at three times, colours, indices."""

import numpy as np

import warpfea as wf


def test_points_equal_the_positions_at_three_times(tmp_path):
    from pxr import Usd, UsdGeom

    b = wf.ModelBuilder()
    body = b.add_solid(
        wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=wf.SVK(E=1e5, nu=0.3, density=1000.0), name="bar"
    )
    b.clamp(body.nodes("x-"))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1.0 / 60.0)
    kept = {}
    path = tmp_path / "bar.usdc"
    writer = wf.USDWriter(str(path), fps=60)
    sim.run(0.2, outputs=[writer], on_step=lambda s: kept.__setitem__(round(s.time[0] * 60), s.positions(body)[0]))
    stage = Usd.Stage.Open(str(path))
    (mesh,) = [UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    # which mesh node each drawn point is
    nodes = np.asarray(body.skin.node_weights.argmax(axis=1)).ravel()
    for frame in (3, 7, 11):
        local = np.array(mesh.GetPointsAttr().Get(frame), dtype=float)
        matrix = np.array(UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(frame))
        world = local @ matrix[:3, :3] + matrix[3, :3]
        assert np.abs(world - kept[frame][nodes]).max() < 1e-6
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    assert indices.min() >= 0
    assert indices.max() < len(nodes)
    colours = np.array(mesh.GetDisplayColorPrimvar().Get(11))
    assert np.ptp(colours, axis=0).max() > 0.1
