"""Heads and statements of files over 450 lines are packed with `# fmt: skip`: python pack_heads.py TREE. Largest gain first."""
import ast, pathlib, sys, textwrap
root, LIMIT, WIDTH = pathlib.Path(sys.argv[1]).resolve(), 450, 120
def spans(text):
    lines = text.split("\n")
    for n in ast.walk(ast.parse(text)):
        if isinstance(n, ast.FunctionDef):
            a = n.lineno
            b = a
            while b < n.body[0].lineno and not (lines[b - 1].startswith(" " * n.col_offset + ")") and lines[b - 1].rstrip().endswith(":")):
                b += 1
        elif isinstance(n, (ast.Assign, ast.Expr, ast.Return)) and not isinstance(getattr(n, "value", None), (ast.Constant, ast.JoinedStr)):
            a, b = n.lineno, n.end_lineno
        else:
            continue
        if b - a < 4 or any("#" in x for x in lines[a - 1:b]) or any('"""' in x for x in lines[a - 1:b]):
            continue
        head, tail, inner = lines[a - 1], lines[b - 1], lines[a:b - 1]
        indent = len(head) - len(head.lstrip())
        if tail[:indent + 1].strip() not in (")", "]", "}") or head.rstrip()[-1] not in "([{":
            continue
        if any(len(x) - len(x.lstrip()) < indent + 4 for x in inner):
            continue
        body = " ".join(x.strip() for x in inner)
        packed = textwrap.wrap(body, WIDTH - indent - 4, break_long_words=False, break_on_hyphens=False)
        new = [head, *(" " * (indent + 4) + x for x in packed), tail + "  # fmt: skip"]
        if len(new) < b - a + 1 and max(map(len, new)) <= WIDTH:
            yield b - a + 1 - len(new), a, b, new
def same(a, b):
    try:
        return ast.dump(ast.parse(a)) == ast.dump(ast.parse(b))
    except SyntaxError:
        return False
for folder in ("kernels", "warpfea", "scenes"):
    for p in sorted((root / folder).rglob("*.py")):
        text = p.read_text(encoding="utf-8")
        if len(text.splitlines()) <= LIMIT: continue
        first = len(text.splitlines())
        while len(text.splitlines()) > LIMIT:
            for gain, a, b, new in sorted(spans(text), key=lambda s: -s[0]):
                lines = text.split("\n")
                out = "\n".join(lines[:a - 1] + new + lines[b:])
                if same(out, text):
                    text = out
                    break
            else:
                break
        p.write_text(text, encoding="utf-8")
        print("packed", p.relative_to(root), first, "->", len(text.splitlines()))
