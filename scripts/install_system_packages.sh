#!/usr/bin/env bash
# Installs what tests can use beyond Python packages: a browser, for the test of the viewer.
# Never fails and never asks: where it can't install, that test is skipped and says why.
set -u

if command -v chromium >/dev/null || command -v chromium-browser >/dev/null; then
    exit 0
fi
if ! command -v apt-get >/dev/null; then
    echo "no chromium, and no apt-get to install it with: the browser test will be skipped"
    exit 0
fi
as_root=()
if [ "$(id -u)" -ne 0 ]; then
    if ! sudo -n true 2>/dev/null; then
        echo "no chromium, and no right to install it (apt-get install chromium): the browser test will be skipped"
        exit 0
    fi
    as_root=(sudo -n)
fi

options=(-qq -o Acquire::http::Timeout=20 -o Acquire::Retries=1 -o DPkg::Lock::Timeout=60)
echo "installing chromium (once) ..."
export DEBIAN_FRONTEND=noninteractive
if ! { timeout 300 "${as_root[@]}" apt-get "${options[@]}" update &&
    timeout 900 "${as_root[@]}" apt-get "${options[@]}" install --yes --no-install-recommends chromium; } >/dev/null 2>&1; then
    echo "chromium could not be installed: the browser test will be skipped"
fi
exit 0
