#!/usr/bin/env bash
# The rig in a box: a Debian 12 guest under QEMU (plain emulation) with the kernel's own devices that need no hardware:
# vivid (V4L2), vkms (KMS), a USB serial gadget, udev, systemd. Its image is built once and kept under .setup/rig; each
# run starts from it afresh, sees the clone read-only at the same path, and leaves nothing behind.
#
#     setup/rig.sh                      build what is missing, run the tests of tests/rig: drivers first, then the service
#     setup/rig.sh run CMD ARGS...      run a command in the guest (without systemd)
#     setup/rig.sh boot CMD ARGS...     the same, with systemd as the first process
#     setup/rig.sh build                build the image only
#     setup/rig.sh possible             exit 0 if the rig can run here; else say why not
#     setup/rig.sh if-possible          the tests, or a line that says why they could not be run, and exit 0
#     setup/rig.sh told                 a line that says whether the tests passed with these sources
#
# Output comes as it is made, and the exit status is the command's; 125 means that the guest itself failed, 77 that
# packages cannot be had. RIG_TIMEOUT: seconds a guest may take, 900 unless given. RIG_CPUS: its processors, 2 unless
# given.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
clone=$PWD
state=$clone/.setup/rig
box=tests/rig/box

say() { printf 'rig: %s\n' "$*" >&2; }
fail() { printf 'rig: %s\n' "$@" >&2; exit 125; }
cannot() { printf 'rig: %s\n' "$@" >&2; exit 77; }
words() { sed -e 's/#.*//' -e '/^[[:space:]]*$/d' "$1" | xargs; }

missing_packages() {
    local package
    for package in $(words setup/packages-rig.txt); do
        [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || echo "$package"
    done
}

# What this machine lacks, in words; nothing if it will do.
unfit() {
    . /etc/os-release 2>/dev/null || true
    if [ "${VERSION_CODENAME:-}" != bookworm ] || [ "$(uname -m)" != x86_64 ]; then
        echo "the guest shares this machine's Python packages, so it needs Debian 12 on x86-64 here too"
        return
    fi
    local memory disk
    memory=$(awk '/^MemAvailable/ { print int($2 / 1024) }' /proc/meminfo)
    disk=$(df -Pm . | awk 'END { print $4 }')
    if [ "$memory" -lt 2600 ]; then
        echo "the guest takes 2.6 GB of memory, and $memory MB are free"
    elif [ "$disk" -lt 5000 ] && [ ! -e "$state/built" ]; then
        echo "building the guest takes 5 GB of disk, and $disk MB are free"
    fi
}

# Why the rig cannot run here, in words; nothing if it can. Asks the package sources.
obstacle() {
    local why missing
    why=$(unfit)
    [ -z "$why" ] || { echo "$why"; return; }
    missing=$(missing_packages | xargs)
    [ -n "$missing" ] || return 0
    if [ "$(id -u)" != 0 ] && ! sudo -n true 2>/dev/null; then
        echo "packages are missing, and installing them takes root: apt-get install --no-install-recommends $missing"
    elif ! can_install $missing; then
        echo "packages cannot be had here: $missing (another mirror in /etc/apt may mend it)"
    fi
}

# Lists may be absent or old: asked again after an update.
can_install() {
    local as_root=()
    [ "$(id -u)" = 0 ] || as_root=(sudo)
    apt-get install --simulate --no-install-recommends "$@" >/dev/null 2>&1 ||
        { timeout 120 ${as_root[@]+"${as_root[@]}"} apt-get update -q >/dev/null 2>&1 &&
            apt-get install --simulate --no-install-recommends "$@" >/dev/null 2>&1; }
}

install_packages() {
    local missing as_root=()
    missing=$(missing_packages | xargs)
    [ -n "$missing" ] || return 0
    [ "$(id -u)" = 0 ] || as_root=(sudo)
    say "installing distribution packages: $missing"
    # shellcheck disable=SC2086  # a list of words
    ${as_root[@]+"${as_root[@]}"} timeout 600 env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends $missing >&2 ||
        cannot "the packages could not be installed. Type, as root:" \
            "    apt-get update && apt-get install --no-install-recommends $missing" "then this command again."
}

# Into $work/debs: the distribution's kernel, what compiles modules for it, and its source. Runs as mmdebstrap's hook.
fetch_kernel='
    set -e
    mkdir -p "$1/rig-kernel"
    chroot "$1" sh -ec "
        cd /rig-kernel
        image=\$(apt-cache depends linux-image-amd64 | sed -n \"s/.*Depends: //p\" | head -n 1)
        headers=linux-headers-\${image#linux-image-}
        apt-get -qq -o APT::Sandbox::User=root download \$image \$headers \${headers%-amd64}-common linux-kbuild-6.1 linux-source-6.1"
'

make_root() {
    say "making the guest's root"
    local include
    include=$(words $box/guest-packages.txt | tr ' ' ,)
    mkdir "$work/debs"
    printf '#!/bin/sh\n%s' "$fetch_kernel" >"$work/fetch-kernel"
    chmod +x "$work/fetch-kernel"
    timeout 600 mmdebstrap --quiet --variant=minbase --include="$include" \
        --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
        --dpkgopt='path-exclude=/usr/share/locale/*' \
        --customize-hook="$work/fetch-kernel" --customize-hook="sync-out /rig-kernel $work/debs" \
        --customize-hook='rm -rf "$1/rig-kernel"' \
        bookworm "$work/root.tar" >&2 || cannot "the guest's packages could not be had (see above)"
}

make_vkms() {
    say "compiling vkms"
    local deb headers release common
    for deb in "$work"/debs/linux-{image,headers,kbuild}*.deb; do dpkg-deb -x "$deb" "$work/kernel"; done
    release=$(cd "$work/kernel/lib/modules" && echo *)
    headers=$work/kernel/usr/src/linux-headers-$release
    common=$work/kernel/usr/src/linux-headers-${release%-amd64}-common
    sed -i "s#/usr/src/linux-headers-${release%-amd64}-common#$common#" "$headers/Makefile"
    dpkg-deb --fsys-tarfile "$work"/debs/linux-source-*.deb | tar -xO --wildcards './usr/src/linux-source-*.tar.xz' |
        tar -xJ -C "$work" --strip-components=1 --wildcards 'linux-source-*/drivers/gpu/drm/vkms'
    local source=$work/drivers/gpu/drm/vkms
    # Since 6.1.140 the kernel refuses a writeback connector beside the display unless both encoders say that they may
    # show the same picture (drm_atomic_helper.c, check_valid_clones), and 6.1's vkms does not say so.
    sed -i '/writeback = vkms_enable_writeback_connector(vkmsdev);/a encoder->possible_clones = output->wb_connector.encoder.possible_clones = drm_encoder_mask(encoder) | drm_encoder_mask(\&output->wb_connector.encoder);' "$source/vkms_output.c"
    grep -q possible_clones "$source/vkms_output.c" || fail "vkms's source is not as expected: writeback cannot be set up"
    timeout 300 make -s -C "$headers" M="$source" CONFIG_DRM_VKMS=m modules >"$work/vkms.log" 2>&1 ||
        { cat "$work/vkms.log" >&2; fail "vkms does not compile"; }
    local modules=$work/kernel/lib/modules/$release
    (cd "$modules/kernel" && rm -rf sound drivers/{net,scsi,infiniband,iio,hwmon,md,nvme,bluetooth,ata} net/{ceph,mac80211,bluetooth} \
        drivers/gpu/drm/{amd,i915,nouveau,radeon})
    mkdir -p "$modules/extra"
    cp "$source/vkms.ko" "$modules/extra/"
    depmod -b "$work/kernel" "$release" 2>/dev/null
    cp "$work/kernel/boot/vmlinuz-$release" "$work/vmlinuz"
}

make_initramfs() {
    local modules=$work/kernel/lib/modules ram=$work/ram path number=10 release
    release=$(cd "$modules" && echo *)
    mkdir -p "$ram/bin" "$ram/modules"
    cp "$work/tree/bin/busybox" "$ram/bin/"
    cp $box/initramfs "$ram/init"
    modprobe -d "$work/kernel" -S "$release" --show-depends -a virtio_pci virtio_blk virtio_console 9pnet_virtio 9p ext4 crc32c_generic |
        sed -n 's/^insmod \([^ ]*\).*/\1/p' | awk '!seen[$0]++' >"$work/order"
    while read -r path; do
        cp "$path" "$ram/modules/$number-${path##*/}"
        echo "$number-${path##*/}" >>"$ram/modules/order"
        number=$((number + 1))
    done <"$work/order"
    (cd "$ram" && find . | "$ram/bin/busybox" cpio -o -H newc 2>/dev/null) | gzip -1 >"$work/initramfs"
}

make_image() {
    say "writing the image"
    # fakeroot keeps owners and device nodes right in one go, also for an ordinary user.
    WORK=$work fakeroot bash -ec '
        mkdir "$WORK/tree"
        tar -xf "$WORK/root.tar" -C "$WORK/tree" --exclude="./dev/*"
        mkdir -p "$WORK/tree/lib/modules"
        cp -r "$WORK"/kernel/lib/modules/* "$WORK/tree/lib/modules/"
        rm -f "$WORK/tree/etc/resolv.conf"
        for link in build source; do rm -f "$WORK"/tree/lib/modules/*/$link; done
        mke2fs -q -t ext4 -O ^has_journal -m 0 -L rig -d "$WORK/tree" "$WORK/image" 2G >/dev/null' ||
        fail "the image could not be written"
}

build() {
    local stamp why
    stamp=$({ declare -f make_root make_vkms make_image make_initramfs; echo "$fetch_kernel"; cat $box/{guest-packages.txt,initramfs}; } | sha256sum)
    mkdir -p "$state"
    exec 8>"$state/lock"
    flock 8
    [ "$(cat "$state/built" 2>/dev/null)" != "$stamp" ] || { exec 8>&-; return 0; }
    why=$(obstacle)
    [ -z "$why" ] || cannot "$why"
    install_packages
    rm -rf "$state"/work.* "$state/built"
    work=$(mktemp -d "$state/work.XXXXXX")
    trap 'rm -rf "$work"' EXIT
    make_root
    make_vkms
    make_image
    make_initramfs
    mv "$work/image" "$work/vmlinuz" "$work/initramfs" "$state/"
    rm -rf "$work"
    trap - EXIT
    printf '%s' "$stamp" >"$state/built"
    exec 8>&-
}

# A digest of all files below these paths.
digest() {
    find "$@" -type f ! -path '*/__pycache__/*' ! -path '*/build/*' -print0 | sort -z | xargs -0 sha256sum | sha256sum | cut -d' ' -f1
}
everything() { digest scanner drivers service systemd udev docs/examples setup tests/rig tests/contract pyproject.toml; }

# What an installation puts into the guest: the service as `make install` stages it for packagers, and the kernels of its
# decoders. The guest's processor is another one and compiling in it takes minutes, so they are compiled here, for a
# processor that every machine can play. Other packages are those of the clone's .venv.
stage() {
    local stamp kernels site=$state/stage/usr/local/lib/fringed/lib/python3.11/site-packages source
    stamp=$({ declare -f stage carry_kernels; digest scanner drivers service systemd udev docs/examples setup/install-system.sh \
        setup/constraints.txt pyproject.toml $box/compile_kernels.py; } | sha256sum | cut -d' ' -f1)
    [ "$(cat "$state/staged" 2>/dev/null)" != "$stamp" ] || return 0
    say "staging the service and compiling its kernels"
    rm -rf "$state"/{staged,stage} "$state"/kernels/{clone,installed}
    # numba looks at a kernel's own file only: one that calls a kernel of another file would keep the old code inlined.
    kernels=$(digest $(grep -rl --include='*.py' kernel scanner))
    [ "$(cat "$state/kernels/of" 2>/dev/null)" = "$kernels" ] || rm -rf "$state/kernels"
    PREFIX=/usr/local DESTDIR=$state/stage WHEELS='' PIP_NO_DEPS=1 setup/install-system.sh 2>"$state/stage.log" ||
        { cat "$state/stage.log" >&2; cannot "the service could not be staged (see above)"; }
    # numba knows a source by its path, time and size: the same for the clone's own.
    (cd "$site" && find scanner -name '*.py') | while read -r source; do
        [ ! -e "$source" ] || touch -r "$source" "$site/$source"
    done
    PYTHONPATH=$site NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES='' NUMBA_CACHE_DIR=$state/kernels/staged \
        .venv/bin/python -P $box/compile_kernels.py >&2 || fail "the kernels do not compile"
    printf '%s' "$kernels" >"$state/kernels/of"
    carry_kernels "$site" "$clone" clone
    carry_kernels "$site" /usr/local/lib/fringed/lib/python3.11/site-packages installed
    printf '%s' "$stamp" >"$state/staged"
}

# carry_kernels FROM TO NAME: numba's folders are called after the sources' folder, with a digest of its path.
carry_kernels() {
    local folder cached digest
    mkdir -p "$state/kernels/$3"
    (cd "$1" && find scanner -type d ! -name __pycache__) | while read -r folder; do
        digest=$(printf %s "$1/$folder" | sha1sum | cut -d' ' -f1)
        cached=$state/kernels/staged/${folder##*/}_$digest
        [ -d "$cached" ] || continue
        digest=$(printf %s "$2/$folder" | sha1sum | cut -d' ' -f1)
        cp -r "$cached" "$state/kernels/$3/${folder##*/}_$digest"
    done
}

# boot MODE CMD ARGS...
boot() {
    local mode=$1 command status
    local seconds=${RIG_TIMEOUT:-900}
    shift
    printf -v command '%q ' "$@"
    command=$(printf 'exec %s' "$command" | base64 -w 0)
    [ "${#command}" -lt 1600 ] || fail "the command is too long for the kernel's command line; put it into a script"
    run=$(mktemp -d "${TMPDIR:-/tmp}/rig.XXXXXX")
    qemu=
    trap 'kill $qemu 2>/dev/null || true; rm -rf "$run"' EXIT
    trap 'exit 125' INT TERM HUP
    mkfifo "$run/output" # not QEMU's stdio: a guest's port is shut when standard input ends
    cat "$run/output" &
    local reader=$!
    # Nehalem has no AVX, whose masked loads QEMU 7.2 emulates wrongly: they fault where only what is masked out lies on
    # a page that is not there, and NumPy sorts with them.
    # TMPDIR holds the guest's changes to its disk, which snapshot=on throws away.
    TMPDIR=$run timeout --kill-after=10 "$seconds" qemu-system-x86_64 \
        -accel tcg,thread=multi -cpu Nehalem -smp "${RIG_CPUS:-2}" -m 2048 -nodefaults -no-user-config -display none -no-reboot \
        -kernel "$state/vmlinuz" -initrd "$state/initramfs" \
        -append "console=ttyS0 quiet panic=-1 mitigations=off rig.mode=$mode rig.share=$clone rig.command=$command" \
        -drive "file=$state/image,format=raw,if=none,id=root,snapshot=on" -device virtio-blk-pci,drive=root \
        -fsdev "local,id=clone,path=$clone,security_model=none,readonly=on,multidevs=remap" \
        -device virtio-9p-pci,fsdev=clone,mount_tag=clone \
        -chardev "file,id=console,path=$run/console" -serial chardev:console \
        -device virtio-serial-pci \
        -chardev "file,id=output,path=$run/output" -device virtserialport,chardev=output,name=rig.output \
        -chardev "file,id=status,path=$run/status" -device virtserialport,chardev=status,name=rig.status \
        </dev/null &
    qemu=$!
    wait $qemu || true
    qemu=
    [ -e "$run/status" ] || kill $reader 2>/dev/null || true # QEMU did not start: nobody will write
    wait $reader || true
    status=$(tr -dc 0-9 <"$run/status" 2>/dev/null || true)
    if [ -z "$status" ] || [ "$status" = 125 ]; then
        tail -n 40 "$run/console" >&2 || true
        fail "the guest ended without a result (its console is above); RIG_TIMEOUT is $seconds s"
    fi
    rm -rf "$run"
    return "$status"
}

# fast|systemd: the tests that need the guest booted so.
phase() {
    local pytest=("$clone/.venv/bin/python" -m pytest -q -p no:cacheprovider)
    case $1 in
        fast) say "drivers, against the kernel's devices"; boot fast "${pytest[@]}" tests/rig tests/contract/test_window.py ;;
        systemd) say "the service, under systemd"; boot systemd "${pytest[@]}" tests/rig/test_installed.py ;;
    esac
}

# tests [ATTEMPTS]: both phases, each as often as said until it passes.
tests() {
    local status=0 sources name attempt
    sources=$(everything)
    rm -f "$state/passed"
    build
    stage
    for name in fast systemd; do
        for ((attempt = ${1:-1}; attempt > 0; attempt--)); do
            if phase $name; then break; fi
            if [ $attempt -gt 1 ]; then say "once more"; else status=1; fi
        done
    done
    [ $status != 0 ] || printf '%s %s' "$sources" "$(date +%F\ %R)" >"$state/passed"
    return $status
}

# For a script that others wait for. What is not the tests' word (77: packages cannot be had; 125: the guest itself
# failed, or took too long) is told and no failure; and tests that fail are run a second time, since an emulated machine
# on a busy one can be too late for any bound.
tests_if_possible() {
    local status=0 why
    why=$(obstacle)
    if [ -n "$why" ]; then say "tests/rig was not run: $why"; return 0; fi
    RIG_TIMEOUT=${RIG_TIMEOUT:-600} setup/rig.sh tests 2 || status=$?
    case $status in
        77 | 125) say "tests/rig was not run to its end, for the reason above" ;;
        *) return $status ;;
    esac
}

told() {
    local passed why missing
    passed=$(cat "$state/passed" 2>/dev/null || true)
    if [ "${passed%% *}" = "$(everything)" ]; then say "tests/rig passed with these sources, ${passed#* }"; return; fi
    why=$(unfit)
    missing=$(missing_packages | xargs)
    [ -z "$missing" ] || missing="packages are missing, which make rig installs if it can: $missing"
    say "tests/rig did not run to a good end with these sources: ${why:-${missing:-type make rig}}"
}

case ${1:-tests} in
    possible) why=$(obstacle); [ -z "$why" ] || { say "$why"; exit 1; } ;;
    build) build ;;
    run) shift; build; stage; boot fast "$@" ;;
    boot) shift; build; stage; boot systemd "$@" ;;
    tests) tests "${2:-1}" ;;
    if-possible) tests_if_possible ;;
    told) told ;;
    *) fail "no command '$1'; see the top of setup/rig.sh" ;;
esac
