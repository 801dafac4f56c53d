#!/bin/bash
# apply_names.sh TREE: both rename maps, hand edits, formatting, the table of names for tests/test_words.py.
set -e
here=$(cd "$(dirname "$0")" && pwd); tree=$(cd "$1" && pwd)
cp -r "$tree" "${BASE:=$(mktemp -d /tmp/names_base.XXXX)}/tree"; rm -rf "$BASE/tree/.git"
python "$here/rename.py" "$tree" "$here/map_A.csv" "$here/map_B.csv" "$here/map_N.csv" | { grep -v "^NOTHING\|^COLLISION" || true; }
python "$here/hand_edits.py" "$tree"
python "$here/wrap_long.py" "$tree" --code
python "$here/format_after.py" "$tree" > /dev/null
python "$here/wrap_long.py" "$tree"
python "$here/pack_heads.py" "$tree"
python "$here/format_after.py" "$tree"
python "$here/write_renames.py" "$BASE/tree" "$tree" "$here/map_A.csv" "$here/map_B.csv" "$here/map_N.csv"
python "$here/check_names.py" "$tree" "$BASE/tree"
python "$here/check_structs.py" "$tree" | grep -v "has no dissipation" || true
(cd "$tree" && ruff check . ; ruff format --check . | tail -3)
rm -rf "$BASE"
