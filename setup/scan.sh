#!/usr/bin/env bash
# `make scan`: a scan of the simulated rig into a fresh folder scan-DATE-TIME, and the link `scan` to it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
folder=scan-$(date +%Y%m%d-%H%M%S)
n=2
while [ -e "$folder" ]; do folder=${folder%%_*}_$((n++)); done
.venv/bin/fringed scan -o "$folder" "$@"
if [ -L scan ] || [ ! -e scan ]; then
    ln -sfn "$folder" scan
    printf '\nLook at scan/preview.png, and at scan/cloud.ply in MeshLab or CloudCompare.\n' >&2
fi
