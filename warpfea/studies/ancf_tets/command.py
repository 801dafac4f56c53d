"""`warpfea study ancf-tets`."""

from __future__ import annotations

import argparse

from ...base.console import quiet_warp
from ..files import prepare
from ..plots import require_matplotlib
from .comparison import ancf_tets

__all__ = ["run"]


def run(options: argparse.Namespace) -> None:
    """Run it, print the table, and write JSON, CSV and plot into --out, if given."""
    from tqdm import tqdm

    if options.out is not None:  # before any work
        require_matplotlib()
        prepare(options.out)
    hide = True if options.quiet or options.no_progress else None
    with quiet_warp():
        with tqdm(desc="ancf-tets", unit="mesh", leave=False, disable=hide) as bar:

            def on_run(text: str) -> None:
                bar.set_postfix_str(text, refresh=False)
                bar.update()

            found = ancf_tets(
                device=options.device, sizes=options.sizes, repeat=options.repeat, quick=options.quick, on_run=on_run
            )
        print(found.table(), flush=True)
        if options.out is not None:
            for path in found.write(options.out, words=options.words, device=options.device):
                print(f"wrote {path}")
