"""The installed service and others who would drive the projector: a display manager, and the text console.

It begins with an installed service that is not running, and leaves it so, for the tests of test_installed.py.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from drivers.registry import open_projector
from scanner.clock import MonotonicClock
from scanner.errors import DeviceBusy
from service.doctor import Machine, display_holders
from tests.rig import virtio_card
from tests.rig.installed import (
    ON_A_CARD,
    children,
    main_pid,
    must,
    show,
    wait_for,
    write_rig,
)

pytestmark = [pytest.mark.timeout(420), pytest.mark.usefixtures("installed")]

SHIPPED = Path("/usr/local/share/doc/fringed/projector-only.conf")
UNITS = Path("/etc/systemd/system")
OTHERS = ("display-manager.service", "getty@tty1.service")

GREETER = f"""[Unit]
Description=A display manager, as far as the display is concerned: who opens a card first drives its screens
[Service]
Type=exec
ExecStart=/usr/bin/python3 -ISc 'import os, time; card = os.open("{virtio_card.DEVICE}", os.O_RDWR); time.sleep(9999)'
[Install]
Alias=display-manager.service
"""

AT_BOOT = f"""[Unit]
Wants=fringed.service {" ".join(OTHERS)}
"""


def _drives_the_card() -> int:
    """The process that drives the card's screens, 0 if none does, as the kernel has it."""
    number = virtio_card.CARD.resolve().name.removeprefix("card")
    lines = Path(f"/sys/kernel/debug/dri/{number}/clients").read_text().splitlines()[1:]
    # command, pid, dev, master, authenticated, uid, magic
    return next((int(words[-6]) for line in lines if (words := line.split())[-4] == "y"), 0)


def test_a_display_manager_and_the_console_are_kept_off_the_projector() -> None:
    """By the drop-in that is shipped for it: what runs is pushed aside, and at a boot that wants all three it wins."""
    virtio_card.plug_in()
    must("udevadm", "settle", "--timeout=30")
    write_rig(workers=0, projector=ON_A_CARD)
    (UNITS / "greeter.service").write_text(GREETER)
    (UNITS / "at-boot.target").write_text(AT_BOOT)
    must("systemctl", "enable", "greeter")
    must("systemctl", "start", *OTHERS)
    greeter = int(show(OTHERS[0], "MainPID")[0])
    wait_for(lambda: _drives_the_card() == greeter, 10)
    dropped_in = UNITS / "fringed.service.d" / SHIPPED.name
    try:
        with pytest.raises(DeviceBusy) as busy:
            open_projector("kms", virtio_card.DEVICE, {}, MonotonicClock())
        assert f"({greeter})" in (busy.value.hint or "")
        assert any(f"({greeter})" in finding.says for finding in display_holders(Machine()))

        shutil.copy(SHIPPED, dropped_in)
        must("systemctl", "daemon-reload")
        must("systemctl", "start", "fringed")
        _check_alone()
        wait_for(lambda: _drives_the_card() in children(main_pid()).values(), 60)
        must("systemctl", "stop", "fringed")
        must("systemctl", "start", "at-boot.target")
        _check_alone()
    finally:
        dropped_in.unlink(missing_ok=True)
        must("systemctl", "stop", "fringed", *OTHERS)
        must("systemctl", "disable", "greeter")
        write_rig(workers=1)


def _check_alone() -> None:
    assert show("fringed.service", "ActiveState") == ["active"]
    assert [show(unit, "ActiveState") for unit in OTHERS] == [["inactive"], ["inactive"]]
