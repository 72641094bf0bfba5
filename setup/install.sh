#!/usr/bin/env bash
# Brings a clone into a state in which it runs: distribution packages (packages.txt), the virtual environment .venv
# with the project in editable form (versions of constraints.txt), compiled kernels. Each step is skipped where its
# inputs have not changed. Writes nothing outside the clone but distribution packages.
# With the argument --no-kernels the last step is left out (checking sources needs none).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
clone=$PWD
state=$clone/.setup
python=$clone/.venv/bin/python

# Somebody else's environment must not leak into ours.
unset PYTHONPATH PYTHONHOME VIRTUAL_ENV PIP_USER PIP_TARGET PIP_PREFIX PIP_REQUIRE_VIRTUALENV
export PYTHONNOUSERSITE=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1

say() { printf 'set-up: %s\n' "$*" >&2; }
fail() { printf 'set-up: %s\n' "$@" >&2; exit 1; }
wanted_packages() { sed -e 's/#.*//' -e '/^[[:space:]]*$/d' setup/packages.txt; }

missing_packages() {
    local package
    for package in $(wanted_packages); do
        [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || echo "$package"
    done
}

install_packages() {
    if ! command -v dpkg-query >/dev/null; then
        say "this is no Debian: the like of these packages must be installed by hand: $(wanted_packages | xargs)"
        return
    fi
    local missing as_root=()
    missing=$(missing_packages | xargs)
    [ -n "$missing" ] || return 0
    local line="apt-get install -y --no-install-recommends $missing"
    if [ "$(id -u)" != 0 ]; then
        if command -v sudo >/dev/null && { sudo -n true 2>/dev/null || [ -t 0 ]; }; then
            as_root=(sudo)
        else
            fail "distribution packages are missing, and installing them takes root. Type, as root:" \
                "    apt-get update && $line" "then this command again."
        fi
    fi
    say "installing distribution packages: $missing"
    # Package lists may be absent or old; a mirror that is down matters only if a package cannot be had.
    ${as_root[@]+"${as_root[@]}"} apt-get update -q >&2 || say "apt-get update failed; trying with the lists at hand"
    # shellcheck disable=SC2086  # $line is a list of words
    ${as_root[@]+"${as_root[@]}"} env DEBIAN_FRONTEND=noninteractive $line >&2 ||
        fail "the packages could not be installed. Type, as root:" "    apt-get update && $line" "then this command again."
}

make_environment() {
    local stamp
    stamp=$(cat setup/packages.txt setup/constraints.txt pyproject.toml; /usr/bin/python3 -VV; echo "$clone")
    if [ -x "$python" ] && [ "$(cat "$state/environment" 2>/dev/null)" = "$stamp" ]; then
        return 0
    fi
    rm -f "$state/environment"
    # Scripts in an environment hold its path: one made elsewhere, or by another Python, is made anew.
    local made_for
    made_for=$(cat "$state/made-for" 2>/dev/null || true)
    if [ ! -x "$python" ] || [ "$made_for" != "$clone $(/usr/bin/python3 -VV)" ]; then
        say "making .venv"
        /usr/bin/python3 -m venv --clear --system-site-packages .venv ||
            fail "the virtual environment could not be made; is python3-venv installed?"
        printf '%s %s' "$clone" "$(/usr/bin/python3 -VV)" >"$state/made-for"
    fi
    say "installing Python packages (a few minutes the first time)"
    "$python" -m pip install --quiet --no-cache-dir --editable '.[dev]' --constraint setup/constraints.txt >&2 ||
        fail "Python packages could not be installed: see the lines above, mend what they name, and type this again."
    printf '%s' "$stamp" >"$state/environment"
}

compile_kernels() {
    local sources stamp
    sources=$(grep -rlE 'numba|@[a-z_]*kernel|scanner\.lanes|def warm_up' scanner drivers service --include='*.py' | sort)
    # shellcheck disable=SC2086  # file names of this project hold no blanks
    stamp=$(cat setup/constraints.txt $sources | sha256sum; echo "$clone")
    [ "$(cat "$state/kernels" 2>/dev/null)" != "$stamp" ] || return 0
    say "compiling kernels"
    # numba checks a kernel's own file only; one that calls a kernel of another file would keep the old code inlined.
    find scanner drivers service -path '*/__pycache__/*' \( -name '*.nbi' -o -name '*.nbc' \) -delete
    "$python" -m service.warm_up || fail "the kernels could not be compiled: see the lines above."
    printf '%s' "$stamp" >"$state/kernels"
}

mkdir -p "$state"
exec 9>"$state/lock"
flock 9 # two calls at once: the second waits, then finds its work done
install_packages
make_environment
[ "${1:-}" = --no-kernels ] || compile_kernels
