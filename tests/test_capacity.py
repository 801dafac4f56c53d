"""Too many worlds are refused before anything is allocated, with what a world takes and how many fit."""

import pytest

import warpfea as wf
from warpfea.simulation import capacity
from warpfea.solvers import matrix_assembly


def build(worlds, *, contact=False):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_solid(
        wf.mesh.box((0.1, 0.02, 0.02), cells=(4, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0), name="body"
    )
    if contact:
        b.add_contact(body, b.add_collider(wf.HalfSpace(normal=(0, 0, 1), offset=-0.01), name="floor"), mu=0.3)
    b.clamp(body.nodes("x-"))
    return b.finalize(device="cpu", worlds=worlds)


def taken(worlds, **options):
    """Bytes besides the model's constants."""
    sim = wf.Simulation(build(worlds, contact=True), dt=1e-3, **options)
    return sum(count for name, count in sim.bytes().items() if not name.startswith("model."))


@pytest.mark.parametrize("options", [{}, {"integrator": "bdf2", "ledger": False}], ids=["default", "bdf2"])
def test_what_fits_is_told_and_does(options, monkeypatch):
    monkeypatch.setattr(matrix_assembly, "MIN_CHUNK_WORLDS", 2)
    room = (taken(7, **options) + taken(8, **options)) // 2
    monkeypatch.setattr(capacity, "free_bytes", lambda device: int(room / (1.0 - capacity.RESERVED_FRACTION)) + 1)
    text = r"bytes per world, and cpu has .*free; maximum: 7 worlds; take fewer worlds, a coarser mesh"
    with pytest.raises(wf.CapacityError, match=text) as refused:
        wf.Simulation(build(9, contact=True), dt=1e-3, **options)
    monkeypatch.undo()
    monkeypatch.setattr(matrix_assembly, "MIN_CHUNK_WORLDS", 2)
    assert refused.value.worlds == 7
    assert refused.value.bytes == taken(9, **options)
    assert refused.value.per_world == refused.value.bytes // 9


def test_where_there_is_plenty_nothing_is_measured(monkeypatch):
    def fail(self, worlds):
        raise AssertionError("a model was built once more")

    monkeypatch.setattr(wf.Model, "resized", fail)
    assert wf.Simulation(build(3), dt=1e-3).model.worlds == 3


def test_memory_of_the_host_is_known_or_not_asked_for():
    free = capacity.free_bytes(build(1).device)
    assert free is None or free > 0
