"""`warpfea bench`: the kinds of measurement, and the checks of their options."""

import argparse
import pathlib

from ...base.console import quiet_warp
from ...base.devices import find_device
from ...base.errors import UsageError
from ...base.writer import check_target
from .measure import run_kind
from .peer import PEER_KIND
from .sizes import SIZES_KIND
from .worlds import WORLDS_KIND

__all__ = ["BENCH_KINDS", "bench"]

BENCH_KINDS = {"sizes": SIZES_KIND, "peer": PEER_KIND, "worlds": WORLDS_KIND}
"""By name: its option, but for "sizes", which needs none."""


def bench(options: argparse.Namespace) -> None:
    """Do `warpfea bench`. UsageError for options that do not go together, OutputError for an --out in no folder."""
    name = next((name for name in BENCH_KINDS if getattr(options, name, False)), "sizes")
    for option in sorted(set().union(*(kind.options for kind in BENCH_KINDS.values())) - BENCH_KINDS[name].options):
        if getattr(options, option):
            others = " or ".join(f"--{k}" for k in BENCH_KINDS if option in BENCH_KINDS[k].options)
            words = f"goes with {others}" if name == "sizes" else f"does not go with --{name}"
            raise UsageError(f"--{option.replace('_', '-')} {words}")
    if options.out is not None:
        if pathlib.Path(options.out).suffix != ".json":
            raise UsageError(f"--out {options.out}: the file name must end in .json")
        check_target(options.out, (".json",))
    with quiet_warp():
        options.device = str(find_device(options.device))
        run_kind(BENCH_KINDS[name], options)
