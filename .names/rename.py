"""Apply rename maps to a tree: python rename.py TREE map1.csv [map2.csv ...] [--dry] [--no-git] [--check] [--unused]

Columns of a map: kind,old,new,where,reason.
kind   file    old and new are paths; the file is moved, all imports and mentions of it are rewritten
       field   `x.old`; `old: type`, `def old`, `old =` at class level
       arg     `old` not after a dot: parameters, locals, keywords (but not at class level)
       string  string literals alone, `"old"` and `"x.old"`
       others  every NAME token
old    may be dotted, `con.dead`: this sequence alone (kind field: at class level of class `con` too); new is its last part
where  globs by `;` (`**`: all python of kernels, warpfea, scenes, tests); `!glob` leaves out;
       `glob::name` only inside functions or classes of that name, `!glob::name` outside of them
reason with the word `str`: string literals equal to old (its last part) too; names in braces of f-strings always
Rows act at the same time on the names before: a chain a -> b, b -> c does what it says. Where two rows fit a token,
the one with a dotted `old` wins, then `field` or `arg`, then the narrower `where`.
--strings lists string literals that equal a name renamed in their file but stay; --counts: hits of each row
--check lists files where a new name was there before; --dry reports and changes nothing.
"""

import ast
import collections
import csv
import fnmatch
import io
import keyword
import pathlib
import re
import subprocess
import sys
import tokenize

LEFT = []
"""String literals that equal a renamed name of their file and stay."""
CPP = set("alignas alignof and asm auto bool break case catch char class const constexpr continue default delete do double else enum explicit export extern false float for friend goto if inline int long mutable namespace new not operator or private protected public register return short signed sizeof static struct switch template this throw true try typedef typeid typename union unsigned using virtual void volatile while xor".split())
"""Words of C++, which no field of a struct in kernels may have."""
FOLDERS = ("kernels", "warpfea", "scenes", "tests")
SKIP_DOCS = ("CHANGELOG.md",)
SKIP_FILES = ("warpfea/terms/renamed.py", "tests/test_renamed.py", "tests/test_words.py", "tests/oracle.py")
"""Files that name the former names, or run older commits."""


def python_files(root):
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*")):
            if path.relative_to(root).as_posix() in SKIP_FILES:
                continue
            if path.suffix in (".py", ".pyi") and "__pycache__" not in path.parts:
                yield path.relative_to(root).as_posix()


def matches(path, glob):
    if glob == "**":
        return True
    return fnmatch.fnmatchcase(path, glob) or fnmatch.fnmatchcase(path, glob.replace("**/", ""))


class Row:
    def __init__(self, source, line, kind, old, new, where, reason=""):
        self.source, self.line, self.kind, self.old, self.new = source, line, kind.strip(), old.strip(), new.strip()
        self.reason = reason or ""
        self.name = self.old.rsplit(".", 1)[-1]
        self.owner = self.old.rsplit(".", 1)[0] if "." in self.old and self.kind != "file" else ""
        self.new_name = self.new.rsplit(".", 1)[-1]
        self.strings = self.kind == "string" or bool(re.search(r"\bstr\b", self.reason))
        self.only, self.but = [], []
        for glob in filter(None, (g.strip() for g in (where or "").split(";"))):
            out, glob = glob.startswith("!"), glob.lstrip("!")
            path, _, scope = glob.partition("::")
            (self.but if out else self.only).append((path, scope))
        self.count = 0

    @property
    def rank(self):
        width = min((0 if p == "**" else 1 + len(p.replace("*", "")) for p, _ in self.only), default=0)
        scoped = any(s for _, s in self.only)
        return (bool(self.owner), scoped, self.kind in ("field", "arg"), width)

    def fits(self, path, line, scopes):
        def inside(scope):
            return not scope or any(a <= line <= b for a, b in scopes.get(scope, ()))

        if any(matches(path, p) and inside(s) for p, s in self.but):
            return False
        return any(matches(path, p) and inside(s) for p, s in self.only)


def scopes_of(tree):
    out = collections.defaultdict(list)
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.AsyncFunctionDef)):
            out[node.name].append((min([node.lineno, *(d.lineno for d in node.decorator_list)]), node.end_lineno))
    return out


def class_level(tree):
    """(line, name) -> class, of what class bodies define."""
    out = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            for item in node.body:
                if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
                    out[item.lineno, item.target.id] = node.name
                elif isinstance(item, ast.Assign):
                    for t in item.targets:
                        for n in ast.walk(t):
                            if isinstance(n, ast.Name):
                                out[n.lineno, n.id] = node.name
                elif isinstance(item, (ast.FunctionDef, ast.AsyncFunctionDef)):
                    out[item.lineno, item.name] = node.name
    return out


def choose(rows, path, line, scopes, name, before, in_class):
    """The row for a NAME token, or None; `before`: names before its dot, or ()."""
    found = []
    for row in rows.get(name, ()):
        if row.kind == "string" or not row.fits(path, line, scopes):
            continue
        if row.owner:
            ok = before[-1:] == (row.owner.rsplit(".", 1)[-1],) or (row.kind == "field" and in_class == row.owner)
        elif row.kind == "field":
            ok = bool(before) or bool(in_class)
        elif row.kind == "arg":
            ok = not before and not in_class
        else:
            ok = True
        if ok:
            found.append(row)
    return max(found, key=lambda r: r.rank) if found else None


WORD = re.compile(r"[A-Za-z_][A-Za-z_0-9]*")
DOTTED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


def rename_words(text, rows, path, line, scopes, before_of):
    """Names in a piece of code that is not tokenized (f-string placeholder, backticks)."""

    def sub(m):
        start = m.start()
        before = before_of(text, start)
        row = choose(rows, path, line, scopes, m.group(), before, "")
        if row is None:
            return m.group()
        row.count += 1
        return row.new_name

    return WORD.sub(sub, text)


def dotted_before(text, start):
    if start and text[start - 1] == ".":
        m = re.search(r"([A-Za-z_]\w*)[)\]\w\s]*\.$", text[:start])
        return (m.group(1),) if m else ("?",)
    return ()


def in_braces(text, change):
    """Apply `change` to the placeholders of an f-string's text."""
    out, i, depth, first = [], 0, 0, 0
    while i < len(text):
        c = text[i]
        if depth == 0 and text[i : i + 2] in ("{{", "}}"):
            out.append(text[i : i + 2])
            i += 2
            continue
        if c == "{":
            depth += 1
            if depth == 1:
                out.append(c)
                first = i + 1
                i += 1
                continue
        elif c == "}" and depth:
            depth -= 1
            if depth == 0:
                out.append(change(text[first:i]) + c)
                i += 1
                continue
        if depth == 0:
            out.append(c)
        i += 1
    return "".join(out)


def code_words(text, rows, path, line, scopes):
    """Names in code, string literals in it left out."""
    pieces = re.split(r"('[^']*'|\"[^\"]*\")", text)
    return "".join(
        p if k % 2 else rename_words(p, rows, path, line, scopes, dotted_before) for k, p in enumerate(pieces)
    )


def backticks(text, rows, path, line, scopes):
    """Identifiers in `...` of docstrings and comments."""

    def sub(m):
        inner = m.group(1)
        if not re.fullmatch(r"[A-Za-z_][\w.]*(\([\w., =*]*\))?(:\s*[\w.]+)?", inner):
            return m.group()
        return "`" + rename_words(inner, rows, path, line, scopes, dotted_before) + "`"

    return re.sub(r"`([^`\n]+)`", sub, text)


def rewrite(source, path, rows):
    """Source with names replaced."""
    tree = ast.parse(source)
    scopes, levels = scopes_of(tree), class_level(tree)
    docs = set()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            for item in body:
                if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and isinstance(item.value.value, str):
                    docs.add(item.value.lineno)
    exported = {}
    for node in tree.body:
        if isinstance(node, (ast.Assign, ast.AugAssign)) and "__all__" in ast.unparse(node).split("=")[0]:
            exported |= dict.fromkeys(range(node.lineno, node.end_lineno + 1))
    lines = source.splitlines(keepends=True)
    edits = []
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    code = [t for t in tokens if t.type not in (tokenize.NL, tokenize.NEWLINE, tokenize.COMMENT, tokenize.INDENT, tokenize.DEDENT)]
    position = {id(t): k for k, t in enumerate(code)}
    for t in tokens:
        line = t.start[0]
        new = t.string
        if t.type == tokenize.NAME and not keyword.iskeyword(t.string):
            k = position[id(t)]
            before = ()
            if k and code[k - 1].string == ".":
                j = k - 2
                depth = 0
                while j >= 0:  # the name before brackets
                    s = code[j].string
                    if s in ")]}":
                        depth += 1
                    elif s in "([{":
                        depth -= 1
                    elif depth == 0:
                        break
                    j -= 1
                before = (code[j].string,)
                if "from" in (code[max(k - 3, 0)].string, code[max(k - 2, 0)].string):
                    before = before  # module path: files are rewritten apart
            line_text = lines[line - 1].lstrip()
            if import_path(code, k):
                continue
            # alone: modules of `from x import module` are rewritten apart
            row = choose(rows, path, line, scopes, t.string, before, levels.get((line, t.string), "") if not before else "")
            if row is not None:
                new = row.new_name
                row.count += 1
        elif t.type == tokenize.STRING:
            m = re.match(r"([A-Za-z]*)('''|\"\"\"|'|\")", t.string)
            prefix, quote = m.group(1), m.group(2)
            inner = t.string[len(m.group()) : -len(quote)]
            if line in docs:
                new = m.group() + backticks(inner, rows, path, line, scopes) + quote
            elif "f" in prefix.lower():
                new = m.group() + in_braces(inner, lambda s: code_words(s, rows, path, line, scopes)) + quote
            elif line in exported and WORD.fullmatch(inner):
                row = choose(rows, path, line, scopes, inner, (), "")
                if row is not None:
                    row.count += 1
                    new = m.group() + row.new_name + quote
            elif DOTTED.fullmatch(inner):
                head, _, last = inner.rpartition(".")
                found = [r for r in rows.get(last, ()) if r.strings and r.fits(path, line, scopes)]
                other = [r for r in rows.get(last, ()) if r.kind != "string" and r.fits(path, line, scopes)]
                if other and not found:
                    LEFT.append(f"{path}:{line} {t.string} (a name {last} -> {other[0].new_name} there)")
                if found:
                    row = max(found, key=lambda r: r.rank)
                    row.count += 1
                    new = m.group() + (head + "." if head else "") + row.new_name + quote
        elif t.type == tokenize.COMMENT:
            new = backticks(t.string, rows, path, line, scopes)
        if new != t.string:
            edits.append((t.start, t.end, new))
    for (r0, c0), (r1, c1), new in reversed(edits):
        head, tail = lines[r0 - 1][:c0], lines[r1 - 1][c1:]
        lines[r0 - 1 : r1] = (head + new + tail).splitlines(keepends=True)
    return "".join(lines)


def import_path(code, k):
    """Whether a token is part of the module path of an import."""
    j = k
    while j >= 0 and (code[j].type == tokenize.NAME and not keyword.iskeyword(code[j].string) or code[j].string in (".", "...")):
        j -= 1
    return j >= 0 and code[j].string in ("from", "import") and (code[j].string == "from" or code[j - 1].string != "from" and k > j and _dotted_import(code, j, k))


def _dotted_import(code, j, k):
    return not _is_from(code, j)


def _is_from(code, j):
    """Whether `import` at j belongs to a from."""
    i = j - 1
    while i >= 0 and (code[i].type == tokenize.NAME and not keyword.iskeyword(code[i].string) or code[i].string in (".", "...")):
        i -= 1
    return i >= 0 and code[i].string == "from"


# ---- files


def package_of(path):
    """Dotted module of a file below the root as it is imported."""
    parts = list(pathlib.PurePosixPath(path).with_suffix("").parts)
    if parts[0] in ("kernels", "scenes"):
        parts = ["warpfea", *parts]
    if parts[-1] == "__init__":
        parts.pop()
    return ".".join(parts)


def fix_imports(source, path, moves):
    """Absolute and relative imports of moved modules; strings with their dotted names or paths."""
    here = package_of(path).split(".")
    if not path.endswith("__init__.py") and not path.endswith("__init__.pyi"):
        here = here[:-1]
    table = {package_of(a): package_of(b) for a, b in moves.items()}

    def absolute(dots, name):
        if not dots:
            return name
        base = here[: len(here) - (len(dots) - 1)]
        return ".".join([*base, *([name] if name else [])])

    def back(dots, old, new):
        """The new absolute module in the manner of the old one."""
        if not dots:
            return new
        base = here[: len(here) - (len(dots) - 1)]
        parts = new.split(".")
        if parts[: len(base)] == base:
            return dots + ".".join(parts[len(base) :])
        common = 0
        while common < min(len(here), len(parts)) and here[common] == parts[common]:
            common += 1
        return "." * (len(here) - common + 1) + ".".join(parts[common:])

    aliases = {}

    def from_import(m):
        head, dots, name, mid, names = m.groups()
        full = absolute(dots, name or "")
        target = full
        if full in table:
            target = table[full]
        new_names = names
        pieces = re.split(r"(\b[A-Za-z_]\w*\b)", names)
        moved_to = None
        for i in range(1, len(pieces), 2):
            child = f"{full}.{pieces[i]}"
            if child in table:
                parent, leaf = table[child].rsplit(".", 1)
                rest = "".join(pieces[i + 1 : i + 4])
                if not re.match(r"\s+as\b", rest):
                    aliases[pieces[i]] = leaf
                pieces[i] = leaf
                moved_to = parent
        new_names = "".join(pieces)
        if moved_to and moved_to != full:
            target = moved_to
        if target == full and new_names == names:
            return m.group()
        return head + (back(dots, full, target) if target != full else dots + (name or "")) + mid + new_names

    out = re.sub(
        r"(?m)^([ \t]*from[ \t]+)(\.*)([A-Za-z_][\w.]*)?([ \t]+import[ \t]+)(\([^)]*\)|[^\n]*)", from_import, source
    )
    for old, new in table.items():
        out = re.sub(rf"(?<![\w.]){re.escape(old)}(?![\w])(?!\.\w*\.py)", new, out)
    for a, b in moves.items():
        out = out.replace(a, b)
    if aliases:  # from x import module: uses of it
        rows = collections.defaultdict(list)
        for a, b in aliases.items():
            rows[a].append(Row("imports", 0, "arg", a, b, path))
        body = rewrite(out, path, rows)
        out = body
    return out


def fix_docs(text, path, moves, rows, root):
    """Links and code in markdown."""
    folder = pathlib.PurePosixPath(path).parent
    for a, b in moves.items():
        text = text.replace(a, b)
        pa, pb = pathlib.PurePosixPath(a), pathlib.PurePosixPath(b)
        import os

        ra, rb = os.path.relpath(a, folder or "."), os.path.relpath(b, folder or ".")
        text = re.sub(rf"(?<![\w/]){re.escape(ra)}(?![\w])", rb, text)
        if a.startswith("kernels/"):
            text = text.replace(f"[{pa.name}](", f"[{pb.name}](") if ra in text or rb in text else text
        text = text.replace(package_of(a), package_of(b))
    out = []
    for number, line in enumerate(text.split("\n"), 1):
        out.append(re.sub(r"`([^`\n]+)`", lambda m: doc_name(m, rows), line))
    return "\n".join(out)


def doc_name(m, rows):
    """A name in backticks of a page: replaced where all rows of it agree."""
    inner = m.group(1)
    if not re.fullmatch(r"[A-Za-z_][\w.]*(\([\w., =*]*\))?", inner):
        return m.group()

    def sub(w):
        found = {r.new_name for r in rows.get(w.group(), ()) if not r.owner}
        broad = [r for r in rows.get(w.group(), ()) if not r.owner]
        if len(found) == 1 and "." not in inner.replace(w.group(), "", 1)[:0]:
            broad[0].count += 0
            return found.pop()
        return w.group()

    return "`" + WORD.sub(sub, inner) + "`"


# ---- run


def read(maps):
    rows = []
    for name in maps:
        with open(name, newline="", encoding="utf-8") as f:
            for k, r in enumerate(csv.DictReader(f), 2):
                if r.get("kind") and not r["kind"].startswith("#"):
                    rows.append(Row(pathlib.Path(name).name, k, r["kind"], r["old"], r["new"], r["where"], r.get("reason")))
    return rows


def collisions(root, rows, tokens_of):
    """Files in which a new name was there before, of names that a row changes there; not where all of it is renamed."""
    gone = collections.defaultdict(list)
    for row in rows:
        gone[row.name].append(row)
    for row in rows:
        if row.kind == "file":
            continue
        hit = []
        for path, names in tokens_of.items():
            if row.name in names and row.new_name in names and row.name != row.new_name:
                lines = row.kind != "string" and [n for n in names[row.name] if row.fits(path, n, names["::scopes"])]
                same = [n for n in names[row.new_name] if not any(r.fits(path, n, names["::scopes"]) for r in gone.get(row.new_name, ()))]
                if lines and same:
                    hit.append(f"{path}:{same[0]}")
        if hit:
            print(f"COLLISION {row.source}:{row.line} {row.old} -> {row.new_name}: {', '.join(hit[:6])}{' ...' if len(hit) > 6 else ''}")


def public_names(root):
    """Keyword arguments in the public page (API.md beside this file's folder, or README)."""
    page = pathlib.Path(__file__).resolve().parents[1] / "shared" / "API.md"
    return set(re.findall(r"\b([a-z_][a-z_0-9]*)=", page.read_text())) if page.exists() else set()


def keywords_of(root):
    """(path, function, keyword) of functions and methods of the public host code."""
    out = set()
    for path in python_files(root):
        if path.startswith(("warpfea/builder", "warpfea/simulation", "warpfea/materials", "warpfea/model/model", "warpfea/solvers/__init__", "warpfea/outputs", "warpfea/mesh", "warpfea/laws")):
            for node in ast.walk(ast.parse((root / path).read_text())):
                if isinstance(node, ast.FunctionDef) and not node.name.startswith("_") or isinstance(node, ast.FunctionDef) and node.name == "__init__":
                    out |= {a.arg for a in [*node.args.args, *node.args.kwonlyargs]}
    return out


def main():
    options = {a for a in sys.argv[1:] if a.startswith("--")}
    root, *maps = [a for a in sys.argv[1:] if not a.startswith("--")]
    root = pathlib.Path(root).resolve()
    rows = read(maps)
    moves = {r.old: r.new for r in rows if r.kind == "file"}
    by_name = collections.defaultdict(list)
    for row in rows:
        if row.kind != "file":
            by_name[row.name].append(row)
    # the same name with the same place twice
    seen = {}
    for row in rows:
        key = (row.kind, row.old, tuple(row.only), tuple(row.but))
        if key in seen and seen[key].new != row.new:
            print(f"TWICE {row.source}:{row.line} {row.old} -> {row.new} and {seen[key].new}")
        seen[key] = row
        if row.kind != "file" and (not row.new_name.isidentifier() or keyword.iskeyword(row.new_name)):
            print(f"NO NAME {row.source}:{row.line} {row.new}")
        if row.kind != "file" and row.new_name in CPP:
            print(f"WORD OF C++ {row.source}:{row.line} {row.new}")
        if row.kind == "file":
            if not (root / row.old).exists():
                print(f"NO FILE {row.source}:{row.line} {row.old}")
            if (root / row.new).exists() and row.new not in moves:
                print(f"FILE THERE {row.source}:{row.line} {row.new}")
    files = list(python_files(root))
    if "--check" in options:
        tokens_of = {}
        for path in files:
            source = (root / path).read_text()
            names = collections.defaultdict(list)
            for t in tokenize.generate_tokens(io.StringIO(source).readline):
                if t.type == tokenize.NAME:
                    names[t.string].append(t.start[0])
            names["::scopes"] = scopes_of(ast.parse(source))
            tokens_of[path] = names
        collisions(root, rows, tokens_of)
    before = keywords_of(root)
    changed = {}
    for path in files:
        source = (root / path).read_text(encoding="utf-8")
        new = rewrite(source, path, by_name)
        new = fix_imports(new, path, moves)
        if new != source:
            changed[path] = new
    pages = [p.relative_to(root).as_posix() for p in root.rglob("*.md") if not {".git", ".venv"} & set(p.parts)]
    pages += [p for p in ("pyproject.toml",) if (root / p).exists()] + [p.relative_to(root).as_posix() for p in root.glob(".ci/*") if p.is_file()]
    for path in pages:
        if pathlib.Path(path).name in SKIP_DOCS:
            continue
        source = (root / path).read_text(encoding="utf-8")
        new = fix_docs(source, path, moves, by_name if path.endswith(".md") else {}, root)
        if new != source:
            changed[path] = new
    bad = 0
    for path, new in changed.items():
        if path.endswith((".py", ".pyi")):
            try:
                ast.parse(new)
            except SyntaxError as error:
                bad += 1
                print(f"SYNTAX {path}:{error.lineno} {error.msg}: {new.splitlines()[error.lineno - 1]}")
    if "--dry" not in options:
        for path, new in changed.items():
            (root / path).write_text(new, encoding="utf-8")
        for a, b in moves.items():
            if (root / a).exists():
                (root / b).parent.mkdir(parents=True, exist_ok=True)
                if "--no-git" in options:
                    (root / a).rename(root / b)
                else:
                    subprocess.run(["git", "-C", str(root), "mv", a, b], check=True)
        lost = (before - keywords_of(root)) & public_names(root)
        if lost:
            print(f"PUBLIC KEYWORDS GONE: {', '.join(sorted(lost))}")
    for row in rows:
        if row.kind != "file" and row.count == 0:
            print(f"NOTHING {row.source}:{row.line} {row.kind} {row.old} -> {row.new} in {row.only}")
    if "--strings" in options:
        print("\n".join(f"STRING {x}" for x in LEFT))
    if "--counts" in options:
        for row in rows:
            print(f"{row.count:6d} {row.source}:{row.line} {row.old} -> {row.new}")
    print(f"{len(changed)} files, {sum(r.count for r in rows)} names, {len(moves)} files moved, {bad} broken")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
