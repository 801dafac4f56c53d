"""Lines over 120 columns that no formatter breaks: python wrap_long.py TREE [--code].
--code (before the formatter): statements that end with `# fmt: skip` are broken after a comma, so that they keep it.
Else (after it): comments and docstrings are wrapped, what is over goes to the front of the next line of the paragraph."""
import ast, io, pathlib, re, sys, tokenize
root, WIDTH = pathlib.Path(sys.argv[1]).resolve(), 120
CODE = "--code" in sys.argv

def parses(text):
    try:
        ast.parse(text); return True
    except SyntaxError:
        return False

def same(a, b):
    try:
        return ast.dump(ast.parse(a)) == ast.dump(ast.parse(b))
    except SyntaxError:
        return False

def strings(text):
    """Last words of over-long string literals go to the next literal of the same text."""
    for _ in range(200):
        lines = text.split("\n"); done = False
        for k in range(len(lines) - 1):
            m, n = re.match(r'(\s*f?")(.*) (")$', lines[k]), re.match(r'(\s*f?")(.*)$', lines[k + 1])
            if len(lines[k]) <= WIDTH or not m or not n:
                continue
            for cut in [x.start() for x in re.finditer(" ", m.group(2))][::-1]:
                if len(m.group(1)) + cut + 2 <= WIDTH:
                    new = lines[:k] + [m.group(1) + m.group(2)[:cut] + ' "', n.group(1) + m.group(2)[cut + 1:] + " " + n.group(2)] + lines[k + 2:]
                    if same("\n".join(new), text):
                        text, done = "\n".join(new), True
                        break
            if done:
                break
        if not done:
            return text
    return text

def skipped(text):
    """Lines of statements that keep their own format."""
    lines = text.split("\n"); out = set()
    for n in ast.walk(ast.parse(text)):
        if isinstance(n, (ast.FunctionDef, ast.ClassDef)):
            a, b = n.lineno, n.body[0].lineno - 1
            for k in range(a, b + 1):  # ends where the head does
                if lines[k - 1].rstrip().endswith("# fmt: skip"):
                    out.update(range(a, k + 1)); break
        elif isinstance(n, ast.stmt) and not isinstance(n, (ast.If, ast.For, ast.While, ast.With, ast.Try)):
            if lines[n.end_lineno - 1].rstrip().endswith("# fmt: skip"):
                out.update(range(n.lineno, n.end_lineno + 1))
    return out

def code(text):
    while True:
        lines = text.split("\n")
        skipped_rows = skipped(text)
        rows = [k for k in sorted(skipped_rows) if len(lines[k - 1]) > WIDTH]
        done = False
        for k in rows:
            line = lines[k - 1]
            indent = len(line) - len(line.lstrip())
            tail = "  # fmt: skip" if line.rstrip().endswith("# fmt: skip") else ""
            target = re.match(r"(\s*)([\w, ]+?),? = \($", line)
            if target:
                new = lines[:k - 1] + [target.group(1) + "(", target.group(1) + "    " + target.group(2) + ",", target.group(1) + ") = ("] + lines[k:]
                if same("\n".join(new), text):
                    text, done = "\n".join(new), True
                    break
            first = re.match(r"\s*(def |class |\w[\w.\[\], ]*[=(] ?)", line) and (line.count("(") + line.count("[") > line.count(")") + line.count("]"))
            def depth(part):
                return sum(part.count(c) for c in "([{") - sum(part.count(c) for c in ")]}")
            for cut in [m.end() for m in re.finditer(r",(?= )", line[:WIDTH])][::-1]:
                d = depth(line[:cut])
                if not line[:cut].strip() or d != (1 if first else 0):
                    continue
                pad, rest, after = " " * (indent + 4 * d), line[cut:].strip(), lines[k] if k < len(lines) else ""
                more = after.startswith(pad) and not after.startswith(pad + " ") and after.strip()[0] not in ")]}" and rest.endswith(",") and k + 1 in skipped_rows
                new = lines[:k - 1] + [line[:cut], pad + rest + (" " + after.strip() if more else "")] + lines[k + more:]
                if same("\n".join(new), text):
                    text, done = "\n".join(new), True
                    break
            if done:
                break
        if not done:
            return text

def prose(text):
    """Line numbers of docstrings and of comments of their own -> kind."""
    out = {}
    for n in ast.walk(ast.parse(text)):
        body = getattr(n, "body", None)
        if isinstance(body, list):
            for item in body:
                if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and isinstance(item.value.value, str):
                    out |= dict.fromkeys(range(item.lineno, item.end_lineno + 1), "doc")
    for t in tokenize.generate_tokens(io.StringIO(text).readline):
        if t.type == tokenize.COMMENT and t.line.lstrip().startswith("#"):
            out[t.start[0]] = "comment"
        elif t.type == tokenize.COMMENT and len(t.line.rstrip()) > WIDTH and "type: ignore" not in t.string and "fmt:" not in t.string and "noqa" not in t.string:
            out[t.start[0]] = "tail"
    return out

ITEM = re.compile(r"\s*([A-Za-z_][\w, ]*: |- |\* |\d+\. |\|)")
def docs(text):
    for _ in range(500):
        lines = text.split("\n"); kinds = prose(text)
        k = next((k for k in sorted(kinds) if len(lines[k - 1]) > WIDTH), None)
        if k is None:
            return text
        line, kind = lines[k - 1], kinds[k]
        indent = len(line) - len(line.lstrip())
        if kind == "tail":
            m = line.rindex("  #")
            new = [" " * indent + line[m:].strip(), line[:m].rstrip()]
            lines[k - 1:k] = new; text = "\n".join(lines); continue
        lead = " " * indent + ("# " if kind == "comment" else "")
        cut = line.rfind(" ", len(lead) + 1, WIDTH + 1)
        if cut < 0:
            print("NOT WRAPPED", line[:80]); return text
        head, rest = line[:cut].rstrip(), line[cut:].strip()
        after = lines[k] if k < len(lines) else ""
        goes_on = kinds.get(k + 1) == kind and after.strip() not in ("", '"""', "#") and not ITEM.match(after.lstrip("# ")) and not rest.endswith('"""')
        inner = len(after) - len(after.lstrip())
        if goes_on and (inner == indent or inner == indent + 4):
            lead2 = " " * inner + ("# " if kind == "comment" else "")
            lines[k - 1:k + 1] = [head, lead2 + rest + " " + after.strip().removeprefix("# ")]
        else:
            item = kind == "doc" and ITEM.match(line) and not line.lstrip().startswith(('"""', 'r"""'))
            lines[k - 1:k] = [head, lead + ("    " if item else "") + rest]
        text = "\n".join(lines)
    return text

for folder in ("kernels", "warpfea", "scenes", "tests"):
    for p in sorted((root / folder).rglob("*.py")):
        text = p.read_text(encoding="utf-8")
        if any(len(x) > WIDTH for x in text.split("\n")):
            new = code(text) if CODE else docs(strings(text))
            if new != text:
                assert parses(new), p
                p.write_text(new, encoding="utf-8")
