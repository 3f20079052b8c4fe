#!/bin/sh
# Make sure that MuJoCo can render without a screen: install EGL where it is missing and we may.
# Usage: install_gl.sh PYTHON
set -u

renders() {
    "$1" - <<'PY' >/dev/null 2>&1
from sims.cameras.graphics import open_context
open_context(8, 8, 1).free()
PY
}

packages="libegl1 libgl1 libgl1-mesa-dri"
renders "$1" && exit 0
if command -v apt-get >/dev/null && [ "$(id -u)" = 0 ]; then
    apt-get update -qq && apt-get install -y -qq --no-install-recommends $packages >/dev/null
    renders "$1" && exit 0
fi
echo "MuJoCo cannot render here: OpenGL's system libraries are missing or broken." >&2
echo "On Debian or Ubuntu: sudo apt-get install $packages" >&2
