#!/usr/bin/env bash
# Installs what tests can use beyond Python packages: a browser, for the test of the viewer.
# Never asks. Where it can't install, that test is skipped and says why; in CI (the variable CI is set) this fails instead,
# on Linux: other systems run the tests without a browser.
set -u

missing() {
    if [ -n "${CI:-}" ] && [ "$(uname -s)" = Linux ]; then
        echo "$1: CI needs a browser" >&2
        exit 1
    fi
    echo "$1: the browser test will be skipped"
    exit 0
}

if command -v chromium >/dev/null || command -v chromium-browser >/dev/null; then
    exit 0
fi
if ! command -v apt-get >/dev/null; then
    missing "no chromium, and no apt-get to install it with"
fi
as_root=()
if [ "$(id -u)" -ne 0 ]; then
    if ! sudo -n true 2>/dev/null; then
        missing "no chromium, and no right to install it (apt-get install chromium)"
    fi
    as_root=(sudo -n)
fi

options=(-qq -o Acquire::http::Timeout=20 -o Acquire::Retries=1 -o DPkg::Lock::Timeout=60)
echo "installing chromium (once) ..."
export DEBIAN_FRONTEND=noninteractive
if ! { timeout 300 "${as_root[@]}" apt-get "${options[@]}" update &&
    timeout 900 "${as_root[@]}" apt-get "${options[@]}" install --yes --no-install-recommends chromium; } >/dev/null 2>&1; then
    missing "chromium could not be installed"
fi
