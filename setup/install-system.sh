#!/usr/bin/env bash
# Installs fringed as a service: program below PREFIX, units, udev rules, users, kernel settings; `--remove` undoes it.
# `--prepare` is the last step alone (users, folders, kernel settings, rules read anew), for what a package has unpacked.
# PREFIX (default /usr/local) and DESTDIR (a staging folder, for packagers) are taken from the environment; WHEELS is
# a folder of wheels for a machine without network: pip wheel --wheel-dir FOLDER --constraint setup/constraints.txt .
# Captures, scans and /etc/fringed/rig.toml are never touched.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
umask 022 # what is installed is for every user to read, whatever root's own is
prefix=${PREFIX:-/usr/local}
stage=${DESTDIR:-}
home=$prefix/lib/fringed
# Distribution packages own /usr/lib; what an administrator installs goes to /etc.
if [ "$prefix" = /usr ]; then conf=/usr/lib unit=/usr/lib/systemd/system udev=/usr/lib/udev/rules.d
else conf=/etc unit=/etc/systemd/system udev=/etc/udev/rules.d; fi

say() { printf 'install: %s\n' "$*" >&2; }
fail() { printf 'install: %s\n' "$@" >&2; exit 1; }

files=( # source, target
    systemd/fringed.service          "$unit/fringed.service"
    systemd/fringed-worker@.service  "$unit/fringed-worker@.service"
    systemd/sysusers.conf            "$conf/sysusers.d/fringed.conf"
    systemd/tmpfiles.conf            "$conf/tmpfiles.d/fringed.conf"
    systemd/sysctl.conf              "$conf/sysctl.d/70-fringed.conf"
    systemd/modprobe.conf            "$conf/modprobe.d/fringed.conf"
    udev/70-fringed.rules            "$udev/70-fringed.rules"
    systemd/projector-only.conf      "$prefix/share/doc/fringed/projector-only.conf"
    docs/examples/rig.toml           "$prefix/share/doc/fringed/rig.toml"
)

tell_system() {
    [ -z "$stage" ] || return 0
    if [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
    if command -v udevadm >/dev/null && [ -d /run/udev ]; then udevadm control --reload; udevadm trigger; fi
}

remove() {
    [ -n "$stage" ] || [ ! -d /run/systemd/system ] || systemctl disable --now fringed.service 2>/dev/null || true
    for ((i = 1; i < ${#files[@]}; i += 2)); do rm -f "$stage${files[i]}"; done
    rm -rf "$stage$home" "$stage$prefix/bin/fringed" "$stage$prefix/share/doc/fringed"
    tell_system
    say "removed; kept: /etc/fringed, /var/lib/fringed, and the user and group fringed"
}

install_program() {
    local wanted
    sources=$(mktemp -d)
    trap 'rm -rf "$sources"' EXIT
    if [ -n "${WHEELS:-}" ]; then
        wanted=(--no-index --find-links "$WHEELS" fringed)
    else
        # A copy: building leaves files behind, and what an earlier build left in the clone would be installed again.
        cp -r pyproject.toml README.md LICENSE scanner drivers service "$sources/"
        find "$sources" -name __pycache__ -prune -exec rm -rf {} +
        wanted=("$sources")
    fi
    say "installing the program into $stage$home (a minute or two)"
    mkdir -p "$stage$home" "$stage$prefix/bin"
    /usr/bin/python3 -m venv --clear --system-site-packages "$stage$home"
    env -u PYTHONPATH -u PYTHONHOME -u PIP_USER PIP_DISABLE_PIP_VERSION_CHECK=1 \
        "$stage$home/bin/python" -m pip install --quiet --no-cache-dir --constraint setup/constraints.txt "${wanted[@]}" >&2 ||
        fail "Python packages could not be installed: see the lines above."
    rm -rf "$sources"
    # Scripts that pip writes hold the staging folder's path; this one does not.
    printf '#!/bin/sh\nexec %s/bin/python -P -m service.cli "$@"\n' "$home" >"$stage$prefix/bin/fringed"
    chmod 755 "$stage$prefix/bin/fringed"
}

install_files() {
    for ((i = 0; i < ${#files[@]}; i += 2)); do
        mkdir -p "$stage$(dirname "${files[i + 1]}")"
        sed -e "s#@BIN@#$prefix/bin#g" -e "s#@DOC@#$prefix/share/doc/fringed#g" "${files[i]}" >"$stage${files[i + 1]}"
        chmod 644 "$stage${files[i + 1]}"
    done
    mkdir -p "$stage$prefix/share/doc/fringed/how-to"
    cp docs/how-to/run-as-a-service.md "$stage$prefix/share/doc/fringed/how-to/"
}

prepare_system() {
    systemd-sysusers "$conf/sysusers.d/fringed.conf"
    systemd-tmpfiles --create "$conf/tmpfiles.d/fringed.conf"
    sysctl -q -p "$conf/sysctl.d/70-fringed.conf" || say "kernel settings take effect at the next boot"
    tell_system
    say "done. Write /etc/fringed/rig.toml (an example: $prefix/share/doc/fringed/rig.toml), then type:" \
        "fringed check-config /etc/fringed/rig.toml && systemctl enable --now fringed"
}

[ -n "$stage" ] || [ "$(id -u)" = 0 ] || fail "this takes root (sudo make install), or DESTDIR= for a staging folder"
case ${1:-} in
    --remove) remove ;;
    --prepare) prepare_system ;;
    '')
        install_program
        install_files
        if [ -n "$stage" ]; then say "staged below $stage: where it is unpacked, run setup/install-system.sh --prepare"
        else prepare_system; fi ;;
    *) fail "unknown argument: $1" ;;
esac
