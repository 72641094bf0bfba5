# What the rig in a box needs of this machine, and why it may not be possible here. Read by setup/rig.sh, which has
# `clone`, `state`, `say`, `cannot` and `within`; runs nothing by itself.

memory_mb=2600 # the guest's 2 GB, QEMU's own, and room to breathe
disk_mb=3500   # root, kernel and image beside each other, while the image is built
temporary_mb=1500
# What is booted and run, and what is built before that, in less time takes a faster machine than any that was seen.
time_s=360
time_to_build_s=90

words() { sed -e 's/#.*//' -e '/^[[:space:]]*$/d' "$1" | xargs; }
as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi; }
free_mb() { df -Pm "$1" | awk 'END { print $4 }'; }

missing_packages() {
    local package
    for package in $(words setup/packages-rig.txt); do
        [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || echo "$package"
    done
}

# Of the machine, or of the container that this is, if that may have less.
free_memory_mb() {
    local free limit used
    free=$(awk '/^MemAvailable/ { print int($2 / 1024) }' /proc/meminfo)
    limit=$(cat /sys/fs/cgroup/memory.max /sys/fs/cgroup/memory/memory.limit_in_bytes 2>/dev/null | head -n 1)
    used=$(cat /sys/fs/cgroup/memory.stat /sys/fs/cgroup/memory/memory.stat 2>/dev/null |
        awk '$1 == "anon" || $1 == "total_rss" { print $2; exit }') # what is cached can be had
    case $limit in
        '' | max) ;;
        *) limit=$(awk -v limit="$limit" -v used="${used:-0}" 'BEGIN { printf "%d", (limit - used) / 1048576 }')
            [ "$limit" -ge "$free" ] || free=$limit ;;
    esac
    echo "$free"
}

least_time_s() { if [ -n "$(outdated)" ]; then echo $((time_s + time_to_build_s)); else echo $time_s; fi; }

# What this machine lacks, in words; nothing if it will do.
unfit() {
    . /etc/os-release 2>/dev/null || true
    if [ "${VERSION_CODENAME:-}" != bookworm ] || [ "$(uname -m)" != x86_64 ]; then
        echo "the guest shares this machine's Python packages, so it needs Debian 12 on x86-64 here too"
    elif [ "$(free_memory_mb)" -lt $memory_mb ]; then
        echo "it takes $memory_mb MB of memory, and $(free_memory_mb) MB are free"
    elif [ -n "$(outdated)" ] && [ "$(free_mb .)" -lt $disk_mb ]; then
        echo "building the guest takes $disk_mb MB of disk in $clone, and $(free_mb .) MB are free"
    elif [ -n "$(outdated)" ] && [ "$(free_mb "${TMPDIR:-/tmp}")" -lt $temporary_mb ]; then
        echo "building the guest takes $temporary_mb MB in ${TMPDIR:-/tmp}, and $(free_mb "${TMPDIR:-/tmp}") MB are free"
    elif [ -n "${RIG_BUDGET:-}" ] && [ $((RIG_BUDGET - SECONDS)) -lt "$(least_time_s)" ]; then
        echo "it takes seven minutes to half an hour, and $((RIG_BUDGET - SECONDS)) s are left"
    fi
}

# Why the rig cannot run here, in words; nothing if it can. Asks the package sources, for a minute or two at most.
obstacle() {
    local why missing known
    why=$(unfit)
    [ -z "$why" ] || { echo "$why"; return; }
    missing=$(missing_packages | xargs)
    if [ -n "$missing" ] && ! as_root true 2>/dev/null; then
        echo "packages are missing, and installing them takes root: apt-get install --no-install-recommends $missing"
    elif [ -n "$missing" ] && [ "$(free_mb /usr)" -lt 1000 ]; then
        echo "packages are missing ($missing), they take 1000 MB, and $(free_mb /usr) MB are free in /usr"
    elif [ -n "$missing$(outdated)" ] && ! reachable; then
        known=$(archive)
        echo "the archive of Debian bookworm cannot be reached: ${known:-/etc/apt names none} (another in /etc/apt, or a proxy, may mend it)"
    elif [ -n "$missing" ] && ! can_install "$missing"; then
        echo "packages cannot be had here: $missing (another archive in /etc/apt may mend it)"
    fi
}

# This machine's own sources of Debian packages, as lines of a sources.list; nothing if it does not know them (yet).
sources() {
    apt-get indextargets --format '$(REPO_URI) $(CODENAME) $(COMPONENT)' 'Created-By: Packages' 'Origin: Debian' 2>/dev/null |
        awk '$2 ~ /^bookworm(-updates|-security)?$/ && $3 == "main" && !seen[$0]++ {
            print "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] " $1, $2, $3 }'
}

# The address of the archive, with a slash at its end; nothing if this machine knows none (yet).
archive() { sources | awk '$4 == "bookworm" { print $3; exit }'; }

# Fetched with apt's own means: its proxies and certificates are what counts. Lists may be absent: asked again after an
# update.
reachable() {
    local folder status=0
    [ -n "$(archive)" ] || as_root timeout 120 apt-get update -q >/dev/null 2>&1 || return 1
    [ -n "$(archive)" ] || return 1
    folder=$(mktemp -d)
    timeout 40 /usr/lib/apt/apt-helper -o Acquire::Retries=0 -o Acquire::http::Timeout=10 -o Acquire::https::Timeout=10 \
        download-file "$(archive)dists/bookworm/InRelease" "$folder/InRelease" >/dev/null 2>&1 || status=1
    rm -rf "$folder"
    return $status
}

# can_install PACKAGES: lists may be absent or old: asked again after an update.
can_install() {
    # shellcheck disable=SC2086  # a list of words
    apt-get install --simulate --no-install-recommends $1 >/dev/null 2>&1 ||
        { as_root timeout 120 apt-get update -q >/dev/null 2>&1 &&
            apt-get install --simulate --no-install-recommends $1 >/dev/null 2>&1; }
}

install_packages() {
    local missing
    missing=$(missing_packages | xargs)
    [ -n "$missing" ] || return 0
    say "installing distribution packages: $missing"
    within 600 "installing packages"
    # shellcheck disable=SC2086  # a list of words
    as_root timeout "$bound" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -o DPkg::Lock::Timeout=60 --no-install-recommends $missing >&2 ||
        cannot "the packages could not be installed. Type, as root:" \
            "    apt-get update && apt-get install --no-install-recommends $missing" "then this command again."
}
