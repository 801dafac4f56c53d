"""Edits that rename.py can't make: python hand_edits.py TREE (after rename.py). Regular expressions on text, wherever
their lines are now; prints an edit that found nothing where its text is not there already."""
import pathlib, re, sys
root = pathlib.Path(sys.argv[1]).resolve()
EDITS = [
    ("kernels/**/*.py", r"(traits\.suffix\([^)]*)'gated'", r"\1'has_constraints'"),
    ("kernels/**/*.py", r"(traits\.suffix\([^)]*)'walls'", r"\1'unilateral'"),
    ("kernels/**/*.py", r"(traits\.suffix\([^)]*)'ties'", r"\1'constraint_rows'"),
    ("tests/test_terms_refused.py", r"'gated', which", "'has_constraints', which"),
    ("pyproject.toml", r'(?m)^(\s*)"laws"', r'\1"time_laws"'),
    ("tests/**/*.py", r"warpfea\.solvers\.band\.LARGEST", "warpfea.solvers.band.MAX_FACTOR_BYTES"),
    ("tests/**/*.py", r"warpfea\.model\.discretisation\.LARGE\b", "warpfea.model.discretisation.ORDERED_NODES"),
    ("tests/**/*.py", r"warpfea\.outputs\.(reel|animation)\.Reel\b", "warpfea.outputs.animation.Animation"),
    ("tests/**/*.py;warpfea/terms/*.py", r"override measure\b", "override stored_energy"),
    ("tests/**/*.py;warpfea/terms/*.py", r"does not override book\b", "does not override energy_increments"),
    ("tests/**/*.py;warpfea/terms/*.py", r"measure gave\b", "stored_energy gave"),
    ("tests/**/*.py;warpfea/terms/*.py", r"book returned\b", "energy_increments returned"),
    ("tests/**/*.py;warpfea/terms/*.py", r"sets booked_rows\b", "sets increment_rows"),
    (
        "warpfea/simulation/controls.py",
        r'(\n +)return f"ControlValue\(\{self\.control\.name!r\}, \{(values\.tolist\(\) if [^}]*)\}\)"',
        r'\1shown = \2\1return f"ControlValue({self.control.name!r}, {shown})"',
    ),
    ("warpfea/terms/contact_starts.py", r"(tables\.masters\[tables\.of\[k\]\])\.limit\b", r"\1.depth_limit"),
    ("warpfea/**/*.py;kernels/**/*.py", r"\ban `StepContext`", "a `StepContext`"),
]
for where, old, new in EDITS:
    hits = 0
    for glob in where.split(";"):
        for p in root.glob(glob):
            if "__pycache__" in p.parts:
                continue
            text = p.read_text(encoding="utf-8")
            out = text
            out, n = re.subn(old, new, text)
            hits += n
            if out != text:
                p.write_text(out, encoding="utf-8")
    if not hits:
        print(f"HAND: nothing in {where}: {old}")

# members of Term by former names: in backticks of its pages, and in the code of README files
sys.path.insert(0, str(root / "warpfea" / "terms"))
from renamed import RENAMED
plain = [n for n in RENAMED if n not in ("commit", "book", "aim")] + ["book", "aim", "commit"]
def members(text):
    return re.sub(r"`(" + "|".join(plain) + r")`", lambda m: f"`{RENAMED[m.group(1)]}`", text)
def block(m):
    text = m.group()
    if "(Term)" not in text:
        return text
    text = re.sub(r"\b(def |Floor\.|Term\.)(" + "|".join(plain) + r")\b", lambda k: k.group(1) + RENAMED[k.group(2)], text)
    return re.sub(r"\bat\b(?=[.,)])(?! a )", "ctx", text)
for p in [*(root / "warpfea" / "terms").glob("*.py"), *root.glob("warpfea/*.md"), *root.glob("warpfea/terms/*.md")]:
    if p.name == "renamed.py":
        continue
    text = p.read_text(encoding="utf-8")
    out = members(text)
    if p.suffix == ".md":
        out = re.sub(r"(?s)```python\n.*?```", block, out)
    if out != text:
        p.write_text(out, encoding="utf-8")
