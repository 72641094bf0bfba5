#!/usr/bin/env bash
# The rig in a box: a Debian 12 guest under QEMU (plain emulation) with the kernel's own devices that need no hardware:
# vivid (V4L2), vkms and virtio-gpu (KMS), a USB serial gadget, udev, systemd. Its image is built once and kept under
# .setup/rig; each run starts from it afresh, sees the clone read-only at the same path, and leaves nothing behind.
#
#     setup/rig.sh                      build what is missing, run the tests of tests/rig: drivers first, then the service
#     setup/rig.sh run CMD ARGS...      run a command in the guest (without systemd)
#     setup/rig.sh steady CMD ARGS...   the same, where this machine cannot make the guest late: its clock counts instructions
#     setup/rig.sh boot CMD ARGS...     the same, with systemd as the first process
#     setup/rig.sh prepare              build what is missing, so that the next call need not; for scripts that have time to spare
#     setup/rig.sh possible             exit 0 if the rig can run here; else say why not
#     setup/rig.sh if-possible          the tests, or a line that says why they could not be run (to their end), and exit 0
#     setup/rig.sh told                 a line that says whether the tests passed with these sources
#
# Where there are two processors and memory for two guests, the one whose clock counts instructions runs beside the other
# two, in time that they leave over: it is the one that lateness does not concern, and it is told at the end.
#
# Output comes as it is made, and the exit status is the command's; 125 means that the guest itself failed, 124 that
# something took longer than it may, 77 that packages cannot be had. RIG_TIMEOUT: seconds a guest may take once it is up,
# 900 unless given; RIG_BOOT: until it is up, 300 unless given, twice that with systemd; RIG_BUDGET: all together; no bound
# unless given. RIG_CPUS: the guest's processors, 2 unless given.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
clone=$PWD
state=$clone/.setup/rig
box=tests/rig/box

exec 7>&2 # where messages go, whatever a command's own is
child=
say() { printf 'rig: %s\n' "$*" >&7; }
fail() { printf 'rig: %s\n' "$@" >&7; exit 125; }
cannot() { printf 'rig: %s\n' "$@" >&7; exit 77; }
late() { say "$1 did not come to its end within $2 s: too slow here"; exit 124; }

# within SECONDS WHAT: into `bound`, so many seconds or what RIG_BUDGET has left
within() {
    bound=$1
    [ -n "${RIG_BUDGET:-}" ] || return 0
    [ $((RIG_BUDGET - SECONDS)) -gt "$bound" ] || bound=$((RIG_BUDGET - SECONDS))
    [ "$bound" -gt 0 ] || { say "no time is left for $2: too slow here"; exit 124; }
}

# bounded WHAT SECONDS CMD ARGS...: in the background, so that a signal is heeded at once; `clear_up` ends it
bounded() {
    local status=0
    within "$2" "$1"
    timeout --kill-after=10 "$bound" "${@:3}" &
    child=$!
    wait $child || status=$?
    child=
    case $status in 124 | 137) late "$1" "$bound" ;; esac
    return $status
}

# What was begun is ended and removed. What stops in the middle of the preparation is not the tests' word.
work= run= reader= preparing= beside= told_beside=
clear_up() {
    local status=$?
    for process in $child $reader $beside; do
        kill "$process" 2>/dev/null || true
        wait "$process" 2>/dev/null || true
    done
    [ -z "$work$run$told_beside" ] || rm -rf "$work" "$run" "$told_beside"
    case $preparing$status in yes0 | yes77 | yes124 | yes125) ;; yes*) fail "the preparation stopped (see above)" ;; esac
    exit $status
}
trap clear_up EXIT
trap 'exit 125' INT TERM HUP

. setup/rig-needs.sh
. setup/rig-image.sh

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
    PREFIX=/usr/local DESTDIR=$state/stage WHEELS='' PIP_NO_DEPS=1 \
        bounded "staging the service" 300 setup/install-system.sh 2>"$state/stage.log" ||
        { cat "$state/stage.log" >&2; cannot "the service could not be staged (see above)"; }
    rm -rf "$site"/{pip,setuptools,pkg_resources,_distutils_hack,distutils-}* # half of all files; unpacking a file takes the guest 2 ms
    # numba knows a source by its path, time and size: the same for the clone's own. Python's own compiled files too.
    (cd "$site" && find scanner -name '*.py') | while read -r source; do
        [ ! -e "$source" ] || touch -r "$source" "$site/$source"
    done
    .venv/bin/python -m compileall -q "$site/scanner"
    PYTHONPATH=$site NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES='' NUMBA_CACHE_DIR=$state/kernels/staged \
        bounded "compiling kernels" 600 .venv/bin/python -P $box/compile_kernels.py >&2 || fail "the kernels do not compile"
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

prepare() {
    preparing=yes
    mkdir -p "$state"
    exec 8>"$state/lock"
    flock 8 # two calls at once: the second waits, then finds its work done
    build
    stage
    exec 8>&-
    preparing=
    say "ready after $SECONDS s"
}

# boot MODE CMD ARGS...
boot() {
    local mode=$1 command status began processors
    shift
    printf -v command '%q ' "$@"
    command=$(printf 'exec %s' "$command" | base64 -w 0)
    [ "${#command}" -lt 1600 ] || fail "the command is too long for the kernel's command line; put it into a script"
    mkdir -p "$state"
    run=$(mktemp -d "$state/run.XXXXXX")
    mkfifo "$run/output" # not QEMU's stdio: a guest's port is shut when standard input ends
    cat "$run/output" &
    reader=$!
    within $((2 * ${RIG_BOOT:-300} + ${RIG_TIMEOUT:-900})) "the guest"
    began=$SECONDS
    start_qemu
    await_guest
    [ -e "$run/status" ] || kill "$reader" 2>/dev/null || true # QEMU did not start: nobody will write
    wait "$reader" || true
    reader=
    status=$(sed -n 's/^ended \([0-9]*\)$/\1/p' "$run/status" 2>/dev/null || true)
    if [ -z "$status" ] || [ "$status" = 125 ]; then
        tail -n 40 "$run/console" >&7 || true
        fail "the guest ended without a result (its console is above)"
    fi
    rm -rf "$run"
    run=
    return "$status"
}

# Plain emulation everywhere: KVM is not to be counted on, and where its node is there it may still hang (nested ones do).
# Nehalem has no AVX, whose masked loads QEMU 7.2 emulates wrongly: they fault where only what is masked out lies on a
# page that is not there, and NumPy sorts with them. TMPDIR holds the guest's changes to its disk, which snapshot=on
# throws away. The second display is for pulling out: its driver, unlike vkms, can be unbound while it is in use.
# Mode steady: each instruction takes the guest 2 ns, whatever it took here, and time in which its one processor has
# nothing to do passes at once. All its clocks and timers follow. 500 million instructions a second are fewer than one
# processor of a Raspberry Pi 3 does. What waits for this machine (its disk, the clone) sees time fly meanwhile.
start_qemu() {
    processors=(-accel tcg,thread=multi -smp "${RIG_CPUS:-2}")
    [ "$mode" != steady ] || processors=(-accel tcg,thread=single -icount shift=1,sleep=off -smp 1)
    TMPDIR=$run setpriv --pdeathsig KILL timeout --kill-after=10 "$bound" setpriv --pdeathsig KILL qemu-system-x86_64 \
        "${processors[@]}" -cpu Nehalem -m 2048 -nodefaults -no-user-config -display none -no-reboot \
        -kernel "$state/vmlinuz" -initrd "$state/initramfs" \
        -append "console=ttyS0 quiet panic=-1 mitigations=off modprobe.blacklist=virtio-gpu,virtio_gpu rig.mode=$mode rig.share=$clone rig.command=$command" \
        -drive "file=$state/image,format=raw,if=none,id=root,snapshot=on" -device virtio-blk-pci,drive=root \
        -fsdev "local,id=clone,path=$clone,security_model=none,readonly=on,multidevs=remap" \
        -device virtio-9p-pci,fsdev=clone,mount_tag=clone \
        -device virtio-gpu-pci,addr=0x10 \
        -chardev "file,id=console,path=$run/console" -serial chardev:console \
        -device virtio-serial-pci \
        -chardev "file,id=output,path=$run/output" -device virtserialport,chardev=output,name=rig.output \
        -chardev "file,id=status,path=$run/status" -device virtserialport,chardev=status,name=rig.status \
        </dev/null &
    child=$!
}

# Until QEMU ended; a guest that does not come up in time, or is not done in time, is ended.
await_guest() {
    local up= patience=${RIG_BOOT:-300}
    [ "$mode" != systemd ] || patience=$((2 * patience))
    while kill -0 "$child" 2>/dev/null; do
        [ -n "$up" ] || ! grep -qs '^up$' "$run/status" || up=$SECONDS
        if [ -z "$up" ] && [ $((SECONDS - began)) -gt "$patience" ]; then late "the guest's start" "$patience"; fi
        if [ -n "$up" ] && [ $((SECONDS - up)) -gt "${RIG_TIMEOUT:-900}" ]; then late "the guest's command" "${RIG_TIMEOUT:-900}"; fi
        sleep 0.5
    done
    local status=0
    wait "$child" || status=$?
    child=
    case $status in 124 | 137) late "the guest" "$bound" ;; esac
}

# fast|steady|systemd: the tests that need the guest booted so.
phase() {
    local pytest=("$clone/.venv/bin/python" -m pytest -q -p no:cacheprovider --durations=5)
    case $1 in
        fast) say "drivers, against the kernel's devices"; boot fast "${pytest[@]}" tests/rig tests/contract/test_window.py ;;
        steady) # no bound on single tests: by the guest's clock waiting for the disk may take minutes
            say "drivers in time, by a clock that counts instructions"
            boot steady "${pytest[@]}" --timeout=0 tests/rig/test_steady*.py ;;
        systemd) say "the service, under systemd"; boot systemd "${pytest[@]}" tests/rig/test_installed{_projector,,_life}.py ;;
    esac
}

tests() {
    local sources name
    sources=$(everything)
    rm -f "$state/passed"
    prepare
    begin_beside steady
    for name in fast systemd; do timed $name; done
    if [ -n "$beside" ]; then end_beside; else timed steady; fi
    printf '%s %s' "$sources" "$(date +%F\ %R)" >"$state/passed"
}

# timed PHASE: ends this script with 1, whatever the command in the guest said, if its tests did not pass.
timed() {
    local began=$SECONDS status=0
    phase "$1" || status=1
    say "this took $((SECONDS - began)) s"
    [ $status = 0 ] || exit $status
}

# begin_beside PHASE: in time that nobody else wants, so that it may well take long to start. Its output is kept for
# `end_beside`, which ends this script if its tests did not pass.
begin_beside() {
    [ "$(nproc)" -ge 2 ] && [ "$(free_memory_mb)" -ge $((2 * memory_mb)) ] || return 0
    told_beside=$(mktemp "$state/told.XXXXXX")
    within 3600 "the guests" # beside the others for as long as they may take
    RIG_BUDGET=$bound RIG_BOOT=$bound RIG_TIMEOUT=$bound nice setup/rig.sh "phase $1" >"$told_beside" 2>&1 &
    beside=$!
}
end_beside() {
    local status=0
    wait "$beside" || status=$?
    beside=
    cat "$told_beside"
    [ $status = 0 ] || exit $status
}

# For a script that others wait for. What is not the tests' word (77: packages cannot be had; 124: too slow here; 125: the
# guest itself failed) is told and no failure. A guest that takes longer than RIG_BOOT to start is so slow that clocks are
# no clocks in it, and what its tests say of promised times means nothing: it takes 12 s where they were made.
tests_if_possible() {
    local status=0 why budget
    RIG_BUDGET=${RIG_BUDGET:-1800}
    why=$(obstacle)
    if [ -n "$why" ]; then say "tests/rig was not run: $why"; return 0; fi
    budget=$((RIG_BUDGET - SECONDS))
    RIG_BUDGET=$budget RIG_BOOT=${RIG_BOOT:-45} timeout --kill-after=20 $((budget + 30)) setup/rig.sh tests &
    child=$!
    wait "$child" || status=$?
    child=
    case $status in
        77 | 124 | 125 | 137) say "tests/rig was not run to its end, for the reason above" ;;
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
    prepare) prepare ;;
    "phase steady") timed steady ;;
    run) shift; prepare; boot fast "$@" ;;
    steady) shift; prepare; boot steady "$@" ;;
    boot) shift; prepare; boot systemd "$@" ;;
    tests) tests ;;
    if-possible) tests_if_possible ;;
    told) told ;;
    *) fail "no command '$1'; see the top of setup/rig.sh" ;;
esac
