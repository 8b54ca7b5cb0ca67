#!/usr/bin/env bash
# What the tests look at pages and windows with: Chromium, its driver, and an X server without a
# screen. Installed where that is possible without asking (root and apt-get); elsewhere the tests
# that need them are skipped, with the reason.
set -euo pipefail

packages=()
command -v chromedriver >/dev/null || packages+=(chromium chromium-driver)
command -v Xvfb >/dev/null || packages+=(xvfb)
[ ${#packages[@]} -gt 0 ] || exit 0

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "installing ${packages[*]}"
    if ! { apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends "${packages[@]}"; } >/dev/null; then
        echo "not installed: ${packages[*]}; the tests that need them are skipped"
    fi
else
    echo "not there: ${packages[*]}; the tests that need them are skipped"
fi
