"""`warpfea study`: comparisons of error against run time."""

from __future__ import annotations

import argparse
import shlex

from ..base.console import quiet_warp
from ..base.errors import UsageError
from .source import progress

__all__ = ["STUDIES", "study"]

STUDIES = ("ancf-tets",)


def study(options: argparse.Namespace) -> int:
    """Do `warpfea study STUDY`."""
    from tqdm import tqdm

    from ..studies.ancf_tets import ancf_tets
    from ..studies.ancf_tets.plots import require_matplotlib
    from ..studies.ancf_tets.report import prepare
    from . import DONE

    if options.what not in STUDIES:
        raise UsageError(f"study {options.what!r} is not part of this version; there is {', '.join(STUDIES)}")
    if options.out is not None:  # before any work
        require_matplotlib()
        prepare(options.out)
    show = progress(options)
    with quiet_warp():
        with tqdm(desc=options.what, unit="mesh", leave=False, disable=None if show is None else not show) as bar:

            def on_run(text: str) -> None:
                bar.set_postfix_str(text, refresh=False)
                bar.update()

            found = ancf_tets(
                device=options.device, sizes=options.sizes, repeat=options.repeat, quick=options.quick, on_run=on_run
            )
        if not options.quiet:
            print(found.table(), flush=True)
        if options.out is not None:
            words = shlex.join(["warpfea", *options.words])
            for path in found.write(options.out, command=words, device=options.device):
                if not options.quiet:
                    print(f"wrote {path}")
    return DONE
