#!/usr/bin/env bash
# Installs the Debian packages named, where apt and the rights to use it are there. Fails otherwise, with apt's last line.
set -euo pipefail
command -v apt-get >/dev/null || exit 1
as_root=()
if [ "$(id -u)" -ne 0 ]; then
    sudo -n true 2>/dev/null || exit 1
    as_root=(sudo -n)
fi
log=$(mktemp)
trap 'rm -f "$log"' EXIT
# A broken third-party source fails the update but not the packages wanted here.
"${as_root[@]}" apt-get update >"$log" 2>&1 || true
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@" >"$log" 2>&1 || {
    tail -n 1 "$log" >&2
    exit 1
}
