"""Write tests/data/renames.csv: python write_renames.py BASE TREE MAPS: old names that are in no file of a folder any more
are banned there; sets the bar of openings of docstrings in tests/test_words.py to what there is."""
import ast, collections, csv, pathlib, re, sys
base, tree, *maps = map(pathlib.Path, sys.argv[1:])
# the names of a module by the test's own function, so that both agree
source = (tree / "tests/test_words.py").read_text()
space = {}
exec(compile(ast.Module([n for n in ast.parse(source).body if isinstance(n, (ast.Import, ast.ImportFrom)) or isinstance(n, ast.FunctionDef) and n.name in ("identifiers", "opening", "openings")], []), "t", "exec"), space)
SKIP = ("warpfea/terms/renamed.py",)
def folders(root):
    out = collections.defaultdict(set)
    for f in ("kernels", "warpfea", "scenes"):
        for p in (root / f).rglob("*.py"):
            rel = p.relative_to(root)
            if rel.as_posix() not in SKIP and "__pycache__" not in rel.parts:
                out["/".join(rel.parts[:-1][:2])] |= set(space["identifiers"](ast.parse(p.read_text())))
    return out
a, b = folders(base), folders(tree)
rows, seen = [], {}
news = set()
for m in maps:
    with open(m, newline="") as f:
        for r in csv.DictReader(f):
            if r["kind"] == "string": continue
            if r["kind"] == "file":
                if not (tree / r["old"]).exists(): rows.append(("file", r["old"], r["new"], ""))
                continue
            old, new = r["old"].rsplit(".", 1)[-1], r["new"].rsplit(".", 1)[-1]
            if old == new or len(old) == 1: continue
            kind, known = seen.get(old, (r["kind"], []))
            seen[old] = (kind, known if new in known else [*known, new])
for old, (kind, known) in sorted(seen.items()):
    where = [f for f in sorted(a) if old in a[f] and old not in b.get(f, ())]
    if where:
        rows.append((kind, old, " or ".join(known), ";".join(where)))
with open(tree / "tests/data/renames.csv", "w", newline="") as f:
    w = csv.writer(f, lineterminator="\n"); w.writerow(("kind", "old", "new", "where")); w.writerows(rows)
count = sum(1 for f in ("kernels", "warpfea", "scenes", "tests/validation") for p in (tree / f).rglob("*.py") for _ in space["openings"](ast.parse(p.read_text())))
out = re.sub(r"(?m)^OPENINGS = \d+", f"OPENINGS = {count}", source)
(tree / "tests/test_words.py").write_text(out)
print(f"renames.csv: {len(rows)} names, {count} docstrings open with What, Where, Whether or How")
