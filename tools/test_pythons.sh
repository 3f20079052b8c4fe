#!/bin/sh
# Test events and the runtime's core on every other Python from 3.11 on that this machine has.
#
#   sh tools/test_pythons.sh [pytest's options]
#
# Interpreters are those on PATH and those of pyenv, but for the version of .venv, which `make test`
# uses. Each gets an environment of its own, .venv-X.Y. What fails is repeated once, alone. The
# script fails if an environment cannot be made, or if a test fails twice.
set -u
cd "$(dirname "$0")/.." || exit 1

tests="tests/events tests/runtime --ignore=tests/runtime/tools"
needs="hypothesis pytest pytest-asyncio pytest-timeout pytest-xdist"
mine="$(.venv/bin/python -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)"

# "X.Y path" for each interpreter, the first of each version.
interpreters() {
    for python in python3 $(seq -f 'python3.%.0f' 11 19) \
        "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.*/bin/python3; do
        "$python" -c 'import sys
if sys.version_info >= (3, 11): print("%d.%d" % sys.version_info[:2], sys.executable)' 2>/dev/null
    done | sort -t. -k2,2n -s | awk -v mine="$mine" '$1 != mine && !seen[$1]++'
}

failed=""
found="$(interpreters)"
[ -n "$found" ] || { echo "no Python but $mine is here"; exit 0; }
echo "$found" | {
    while read -r version python; do
        venv=".venv-$version"
        echo "Python $version ($python)"
        if ! [ -e "$venv/.ready" ]; then
            # shellcheck disable=SC2086
            "$python" -m venv "$venv" && "$venv/bin/python" -m pip install --quiet -e . $needs &&
                touch "$venv/.ready" || { failed="$failed $version"; continue; }
        fi
        run="$venv/bin/python -m pytest -q -m not\ slow -o cache_dir=$venv/.pytest_cache"
        # shellcheck disable=SC2086
        eval "$run" -n 2 '"$@"' $tests </dev/null || {
            echo "Repeated once, alone, is what failed above:"
            eval "$run" --last-failed --last-failed-no-failures none '"$@"' $tests </dev/null
        } || failed="$failed $version"
    done
    [ -z "$failed" ] || { echo "failed on:$failed"; exit 1; }
}
