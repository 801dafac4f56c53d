"""Error against run time of any scene: `wf.study`, `warpfea study SCENE`."""

from .options import StudyOptions
from .report import Row, Study
from .study import study

__all__ = ["Row", "Study", "StudyOptions", "study"]
