#!/usr/bin/env bash
# Installs what the tests of the trigger board's firmware need (packages-firmware.txt). They are not needed for anything
# else: where they cannot be had this says so and is content, and those tests are not run.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'set-up: %s\n' "$*" >&2; }
words() { sed -e 's/#.*//' -e '/^[[:space:]]*$/d' "$1" | xargs; }

missing_packages() {
    local package
    for package in $(words setup/packages-firmware.txt); do
        [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || echo "$package"
    done
}

if ! command -v dpkg-query >/dev/null; then
    say "this is no Debian: the firmware's tests run if the like of these is there: $(words setup/packages-firmware.txt)"
    exit 0
fi
mkdir -p .setup
exec 9>.setup/lock
flock 9
missing=$(missing_packages | xargs)
[ -n "$missing" ] || exit 0
as_root=()
if [ "$(id -u)" != 0 ]; then
    if ! sudo -n true 2>/dev/null; then
        say "the firmware's tests are not run: they need (as root) apt-get install --no-install-recommends $missing"
        exit 0
    fi
    as_root=(sudo)
fi
say "installing what the firmware's tests need: $missing"
line="apt-get install -y --no-install-recommends $missing"
# shellcheck disable=SC2086  # a list of words
${as_root[@]+"${as_root[@]}"} env DEBIAN_FRONTEND=noninteractive $line >&2 ||
    { ${as_root[@]+"${as_root[@]}"} apt-get update -q >&2 &&
        ${as_root[@]+"${as_root[@]}"} env DEBIAN_FRONTEND=noninteractive $line >&2; } ||
    say "the firmware's tests are not run: these packages could not be installed: $missing"
