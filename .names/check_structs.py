"""Attributes of Warp structs that do not exist, in kernels: python check_structs.py TREE (static, for renamed trees)."""
import ast, collections, pathlib, sys
root = pathlib.Path(sys.argv[1])
trees = {p: ast.parse(p.read_text()) for p in sorted((root / "kernels").rglob("*.py"))}
fields = {}       # (file, class) -> fields
maker = {}        # struct function -> class
for p, t in trees.items():
    for f in ast.walk(t):
        if isinstance(f, ast.FunctionDef):
            for c in f.body + [x for i in f.body if isinstance(i, ast.If) for x in i.body]:
                if isinstance(c, ast.ClassDef):
                    s = {x.target.id for x in c.body if isinstance(x, ast.AnnAssign)}
                    if s:
                        fields[p, c.name] = s
                        if f.name.endswith("_struct"):
                            maker[f.name] = s
for p, t in trees.items():
    for node in ast.walk(t):
        if isinstance(node, ast.ClassDef) and any(isinstance(x, ast.AnnAssign) for x in node.body):
            fields.setdefault((p, node.name), {x.target.id for x in node.body if isinstance(x, ast.AnnAssign)})
everything = set().union(*fields.values())
bad = 0
for p, t in trees.items():
    local = {n: s for (q, n), s in fields.items() if q == p}
    for node in ast.walk(t):
        if isinstance(node, ast.Assign):
            targets, values = [], []
            for tg in node.targets:
                targets = tg.elts if isinstance(tg, ast.Tuple) else [tg]
                values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
                for a, v in zip(targets, values):
                    if isinstance(v, ast.Call) and isinstance(v.func, ast.Name) and v.func.id in maker and isinstance(a, ast.Name):
                        local[a.id] = maker[v.func.id]
    byname = collections.defaultdict(set)
    for (q, n), s in fields.items():
        byname[n] |= s
    for f in ast.walk(t):
        if isinstance(f, ast.FunctionDef) and any("wp." in ast.unparse(d) for d in f.decorator_list):
            kinds = {}
            for a in f.args.args:
                if a.annotation is not None and isinstance(a.annotation, ast.Name):
                    s = local.get(a.annotation.id) or byname.get(a.annotation.id)
                    if s:
                        kinds[a.arg] = (a.annotation.id, s)
            for n in ast.walk(f):
                if isinstance(n, ast.Assign) and isinstance(n.targets[0], ast.Name) and isinstance(n.value, ast.Call) and isinstance(n.value.func, ast.Name):
                    s = local.get(n.value.func.id) or byname.get(n.value.func.id)
                    if s:
                        kinds[n.targets[0].id] = (n.value.func.id, s)
            for n in ast.walk(f):
                if isinstance(n, ast.Attribute):
                    v = n.value
                    if isinstance(v, ast.Name) and v.id in kinds and n.attr not in kinds[v.id][1] and n.attr != "mesh":
                        bad += 1
                        print(f"{p.relative_to(root)}:{n.lineno} {f.name}: {v.id} ({kinds[v.id][0]}) has no {n.attr}")
print(bad, "missing")
