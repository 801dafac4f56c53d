"""Time of a GIF beside that of its run: `python tests/gif_price.py FILE [SCENES]` runs scenes on the CPU as
`warpfea run SCENE --gif` does, at 960 x 540 pixels; seconds and processor seconds of the steps and of the drawing.

Kernels of the drawing are compiled by a picture before. Without scenes: `hook`, the run of the README.
"""

import json
import pathlib
import sys
import tempfile
import time

import warpfea as wf
from warpfea.base.provenance import provenance_of
from warpfea.builder.scene import find

SIZE = (960, 540)


class Timed(wf.GIFWriter):
    """Keeps the seconds of its calls, and the number of its frames."""

    seconds, processor = 0.0, 0.0

    def timed(self, call, sim):
        began = time.perf_counter(), time.process_time()
        call(sim)
        self.seconds += time.perf_counter() - began[0]
        self.processor += time.process_time() - began[1]

    def open(self, sim):
        self.timed(super().open, sim)

    def write(self, sim):
        self.timed(super().write, sim)
        self.count = len(self._animation.frames)

    def close(self, sim):
        self.timed(super().close, sim)


def measured(name, folder):
    scene = find(name)
    model = scene().finalize(device="cpu")
    sim = wf.Simulation(model, dt=scene.dt, integrator=scene.integrator, solver=wf.NewtonPCG(tol=scene.tol))
    sim.run(2 * scene.dt, outputs=[wf.PNGWriter(folder / "x.png", size=(64, 64))], progress=False)
    sim.reset()
    out = Timed(folder / "x.gif", speed=scene.speed, size=SIZE, progress=False)
    began = time.perf_counter(), time.process_time()
    sim.run(scene.t_end, outputs=[out], progress=False)
    seconds, processor = time.perf_counter() - began[0], time.process_time() - began[1]
    return {
        "label": name, "frames": out.count, "frames_per_s": out.count / out.seconds,
        "run_s": seconds - out.seconds, "run_processor_s": processor - out.processor,
        "draw_s": out.seconds, "draw_processor_s": out.processor,
    }  # fmt: skip


def main(file, *names):
    with tempfile.TemporaryDirectory() as folder:
        rows = [measured(name, pathlib.Path(folder)) for name in names or ("hook",)]
    words = " ".join(["python tests/gif_price.py FILE", *names])
    content = provenance_of([], "cpu") | {"command": words, "settings": {"size": SIZE}, "rows": rows}
    pathlib.Path(file).write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
