"""Static checks of a renamed tree: python check_names.py TREE BASE: imports that don't resolve; attributes that nothing defines."""
import ast, pathlib, sys
def load(root):
    out = {}
    for f in ("kernels", "warpfea", "scenes", "tests"):
        for p in (root / f).rglob("*.py"):
            if "__pycache__" not in p.parts:
                out[p.relative_to(root).as_posix()] = ast.parse(p.read_text())
    return out
def mod(path):
    parts = list(pathlib.PurePosixPath(path).with_suffix("").parts)
    if parts[0] in ("kernels", "scenes"): parts = ["warpfea"] + parts
    if parts[-1] == "__init__": parts.pop()
    return ".".join(parts)
def top(tree):
    out = set()
    def targets(t):
        for n in ast.walk(t):
            if isinstance(n, ast.Name): out.add(n.id)
    def body(b):
        for n in b:
            if isinstance(n, (ast.FunctionDef, ast.ClassDef)): out.add(n.name)
            elif isinstance(n, ast.Assign): [targets(t) for t in n.targets]
            elif isinstance(n, (ast.AnnAssign, ast.AugAssign)): targets(n.target)
            elif isinstance(n, (ast.Import, ast.ImportFrom)): out.update((a.asname or a.name).split(".")[0] for a in n.names)
            elif isinstance(n, (ast.If, ast.Try, ast.With, ast.For)):
                body(n.body); body(getattr(n, "orelse", []))
                for h in getattr(n, "handlers", []): body(h.body)
                if isinstance(n, ast.For): targets(n.target)
            elif isinstance(n, ast.Expr): pass
    body(tree.body)
    return out
def imports(trees):
    table = {mod(p): t for p, t in trees.items()}
    tops = {m: top(t) for m, t in table.items()}
    pk = set(table)
    for p, t in trees.items():
        here = mod(p).split(".")
        if not p.endswith("__init__.py"): here = here[:-1]
        for n in ast.walk(t):
            if isinstance(n, ast.ImportFrom):
                base = ".".join(here[: len(here) - n.level + 1] + ([n.module] if n.module else [])) if n.level else n.module
                if base.split(".")[0] not in ("warpfea", "tests", "kernels", "scenes"): continue
                if base not in table:
                    yield f"{p}:{n.lineno} no module {base}"; continue
                for a in n.names:
                    if a.name != "*" and a.name not in tops[base] and f"{base}.{a.name}" not in pk and "__getattr__" not in tops[base]:
                        yield f"{p}:{n.lineno} {base} has no {a.name}"
        for n in ast.walk(t):
            if isinstance(n, ast.Assign) and any(isinstance(x, ast.Name) and x.id == "__all__" for x in n.targets) and isinstance(n.value, (ast.List, ast.Tuple)):
                for e in n.value.elts:
                    if isinstance(e, ast.Constant) and e.value not in top(t) and "__getattr__" not in top(t):
                        yield f"{p}:{e.lineno} __all__: {e.value}"
def attributes(trees):
    used, made = {}, set()
    for p, t in trees.items():
        for n in ast.walk(t):
            if isinstance(n, ast.Attribute):
                if isinstance(n.ctx, ast.Load): used.setdefault(n.attr, []).append(f"{p}:{n.lineno}")
                else: made.add(n.attr)
            elif isinstance(n, (ast.FunctionDef, ast.ClassDef)): made.add(n.name)
            elif isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name): made.add(n.target.id)
            elif isinstance(n, ast.Assign):
                for x in n.targets:
                    for y in ast.walk(x):
                        if isinstance(y, ast.Name): made.add(y.id)
            elif isinstance(n, ast.keyword) and n.arg: made.add(n.arg)
            elif isinstance(n, ast.alias): made.add((n.asname or n.name).split(".")[-1])
            elif isinstance(n, ast.Constant) and isinstance(n.value, str) and n.value.isidentifier(): made.add(n.value)
    return {a: w for a, w in used.items() if a not in made}
def keywords(trees):
    """Keyword arguments of calls that no function takes."""
    made, used = set(), {}
    for p, t in trees.items():
        for n in ast.walk(t):
            if isinstance(n, ast.FunctionDef): made |= {a.arg for a in [*n.args.args, *n.args.kwonlyargs, *n.args.posonlyargs]}
            elif isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name): made.add(n.target.id)
            elif isinstance(n, ast.Call):
                f = n.func.attr if isinstance(n.func, ast.Attribute) else getattr(n.func, "id", "")
                if f not in ("SimpleNamespace", "dict"):
                    for k in n.keywords:
                        if k.arg: used.setdefault(k.arg, []).append(f"{p}:{n.lineno}")
    return {a: w for a, w in used.items() if a not in made}
if __name__ == "__main__":
    a, b = load(pathlib.Path(sys.argv[1])), load(pathlib.Path(sys.argv[2]))
    old = set(imports(b))
    bad = [x for x in imports(a) if x not in old]
    print("\n".join(bad[:80]), len(bad), "imports")
    ua, ub = attributes(a), attributes(b)
    new = {k: v for k, v in ua.items() if k not in ub}
    for k, v in sorted(new.items()): print("ATTR", k, v[:4])
    ka, kb = keywords(a), keywords(b)
    for k, v in sorted(ka.items()):
        if k not in kb: print("KEYWORD", k, v[:4])
