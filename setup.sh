#!/bin/sh
# Makes .venv beside this file and installs ema into it. "sh setup.sh dev" adds what the tests need.
set -eu
cd "$(dirname "$0")"
if [ ! -x .venv/bin/pip ]; then
    if ! python3 -m ensurepip --version >/dev/null 2>&1 && command -v apt-get >/dev/null 2>&1; then
        # Debian ships Python without ensurepip; the module is in a package of its own.
        as_root=""
        [ "$(id -u)" -eq 0 ] || as_root="sudo"
        $as_root apt-get update -qq
        $as_root apt-get install -y -qq python3-venv >/dev/null
    fi
    rm -rf .venv
    python3 -m venv .venv
fi
if [ "${1:-}" = "dev" ]; then
    .venv/bin/pip install -q --disable-pip-version-check -e ".[dev]"
else
    .venv/bin/pip install -q --disable-pip-version-check -e .
fi
