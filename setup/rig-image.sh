# The image of the rig in a box: a minimal Debian with the distribution's kernel, vkms compiled for it, and what boots
# them, all below .setup/rig. Read by setup/rig.sh, which has `clone`, `state`, `box`, `say`, `fail`, `cannot` and
# `bounded`, and what setup/rig-needs.sh has; runs nothing by itself.

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
    local include from=()
    include=$(words $box/guest-packages.txt | tr ' ' ,)
    sources >"$work/sources.list"
    [ ! -s "$work/sources.list" ] || from=("$work/sources.list")
    mkdir "$work/debs"
    printf '#!/bin/sh\n%s' "$fetch_kernel" >"$work/fetch-kernel"
    chmod +x "$work/fetch-kernel"
    apt-config dump | grep '^Acquire::https\?::' >"$work/apt.conf" || true # proxies and the like
    bounded "making the guest's root" 600 mmdebstrap --quiet --variant=minbase --include="$include" --aptopt="$work/apt.conf" \
        --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
        --dpkgopt='path-exclude=/usr/share/locale/*' \
        --customize-hook="$work/fetch-kernel" --customize-hook="sync-out /rig-kernel $work/debs" \
        --customize-hook='rm -rf "$1/rig-kernel"' \
        bookworm "$work/root.tar" ${from[@]+"${from[@]}"} >&2 || cannot "the guest's packages could not be had (see above)"
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
    mend_vkms_timer "$source/vkms_crtc.c"
    bounded "compiling vkms" 300 make -s -C "$headers" M="$source" CONFIG_DRM_VKMS=m modules >"$work/vkms.log" 2>&1 ||
        { cat "$work/vkms.log" >&2; fail "vkms does not compile"; }
    local modules=$work/kernel/lib/modules/$release
    (cd "$modules/kernel" && rm -rf sound drivers/{net,scsi,infiniband,iio,hwmon,md,nvme,bluetooth,ata} net/{ceph,mac80211,bluetooth} \
        drivers/gpu/drm/{amd,i915,nouveau,radeon})
    mkdir -p "$modules/extra"
    cp "$source/vkms.ko" "$modules/extra/"
    depmod -b "$work/kernel" "$release" 2>/dev/null
    cp "$work/kernel/boot/vmlinuz-$release" "$work/vmlinuz"
}

# 6.1's vkms stands still for ever where blanks are switched off while their timer fires on another processor: the one
# waits for the timer with the lock that the timer waits for (drm_vblank_disable_and_save, drm_handle_vblank). Nobody
# waits any more: a timer that fires once too often is told that blanks are off, and ends itself.
mend_vkms_timer() {
    sed -i -e 's/hrtimer_cancel(&out->vblank_hrtimer)/hrtimer_try_to_cancel(\&out->vblank_hrtimer)/' \
        -e 's/^\thrtimer_init(&out->vblank_hrtimer/\tif (!out->vblank_hrtimer.function) hrtimer_init(\&out->vblank_hrtimer/' \
        -e 's/DRM_ERROR("vkms failure on handling vblank");/{ spin_unlock(\&output->lock); dma_fence_end_signalling(fence_cookie); return HRTIMER_NORESTART; }/' "$1"
    [ "$(grep -c 'try_to_cancel\|function) hrtimer_init\|HRTIMER_NORESTART' "$1")" = 3 ] ||
        fail "vkms's source is not as expected: its timer cannot be mended"
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
    WORK=$work bounded "writing the image" 300 fakeroot bash -ec '
        mkdir "$WORK/tree"
        tar -xf "$WORK/root.tar" -C "$WORK/tree" --exclude="./dev/*"
        mkdir -p "$WORK/tree/lib/modules"
        cp -r "$WORK"/kernel/lib/modules/* "$WORK/tree/lib/modules/"
        rm -f "$WORK/tree/etc/resolv.conf"
        for link in build source; do rm -f "$WORK"/tree/lib/modules/*/$link; done
        mke2fs -q -t ext4 -O ^has_journal -m 0 -L rig -d "$WORK/tree" "$WORK/image" 2G >/dev/null' ||
        fail "the image could not be written"
}

# A digest of what the image is made from.
image_stamp() {
    { declare -f make_root make_vkms mend_vkms_timer make_image make_initramfs; echo "$fetch_kernel"; cat $box/{guest-packages.txt,initramfs}; } | sha256sum
}
outdated() { if [ "$(cat "$state/built" 2>/dev/null)" != "$(image_stamp)" ]; then echo yes; fi; }

build() {
    local why
    [ -n "$(outdated)" ] || return 0
    why=$(obstacle)
    [ -z "$why" ] || cannot "$why"
    install_packages
    rm -rf "$state"/work.* "$state/built"
    work=$(mktemp -d "$state/work.XXXXXX")
    make_root
    make_vkms
    make_image
    make_initramfs
    mv "$work/image" "$work/vmlinuz" "$work/initramfs" "$state/"
    rm -rf "$work"
    work=
    image_stamp >"$state/built"
}
