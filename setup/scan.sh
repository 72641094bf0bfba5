#!/usr/bin/env bash
# `make scan`: a scan of the simulated rig into a fresh folder scans/TIME, and the link `scan` to the newest one.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
folder=scans/$(date +%Y%m%d-%H%M%S)
n=2
while [ -e "$folder" ]; do folder=${folder%%_*}_$((n++)); done
.venv/bin/fringed scan -o "$folder" "$@"
if [ -L scan ] || [ ! -e scan ]; then
    ln -sfn "$folder" scan
    printf '\nLook at scan/preview.png, and at scan/cloud.ply in MeshLab or CloudCompare.\n' >&2
fi
