"""The program behind `fringed`: its commands by name, and what becomes of errors. Signals are `service.cli`'s.

What each command does stands in `service.commands`; they import devices, arrays and sockets when they run.
"""

from __future__ import annotations

import errno
import inspect
import os
import sys
import tempfile
import traceback
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer

from scanner.errors import ScannerError, StorageError
from scanner.storage import storage_errors
from service.commands import (
    audit,
    calibrate,
    check_config,
    daemon,
    decode,
    devices,
    doctor,
    live,
    patterns,
    preview,
    scan,
    simulate,
    status,
)
from service.terminal import begin_output, error_document, print_error, print_failure, print_json

FAILED, WRONG_USAGE, INTERRUPTED = 1, 2, 130

# The root of usage errors, wherever the installed version of typer keeps it.
_UsageError: Any = typer.BadParameter.__mro__[1]

app = typer.Typer(
    name="fringed",
    help="Structured-light 3-D scanner: projector, camera and trigger board in step, point clouds in millimetres.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(scan.scan)
app.command()(live.live)
app.command()(preview.preview)
app.command()(decode.decode)
app.command()(audit.audit)
app.command()(patterns.patterns)
app.command()(devices.devices)
app.add_typer(calibrate.group, name="calibrate")
app.command()(doctor.doctor)
app.command("check-config")(check_config.check_config)
app.command()(daemon.daemon)
app.command()(daemon.worker)
app.command()(status.status)
app.add_typer(simulate.group, name="simulate")


def _list_whole_sentences(group: typer.Typer) -> None:
    """A list of commands has the first paragraph of each one's help, where only its beginning would be shown."""
    for command in group.registered_commands:
        command.short_help = (inspect.getdoc(command.callback) or "").partition("\n\n")[0].replace("\n", " ")
    for inner in group.registered_groups:
        inner.short_help = None if inner.typer_instance is None else inner.typer_instance.info.help
        if inner.typer_instance is not None:
            _list_whole_sentences(inner.typer_instance)


_list_whole_sentences(app)


def run(words: list[str], *, debug: bool, as_json: bool) -> int:
    """Run one command and return its exit status. No traceback reaches the user, but for `debug`."""
    begin_output()
    try:
        return _flushed(_run(words, as_json))
    except BrokenPipeError:
        _leave_output()  # the reader has what it wanted (fringed ... | head)
        return FAILED
    except Exception as error:  # noqa: BLE001  (the last line of defence: a bug is reported, not shown as a traceback)
        if isinstance(error, OSError) and (fault := _output_fault(error)) is not None:
            _leave_output()
            print_error(str(fault), fault.hint)
            return FAILED
        if isinstance(error, SystemError) and isinstance(error.__cause__, KeyboardInterrupt):
            return _interrupted(as_json)  # Ctrl-C inside a compiled kernel comes out so
        _report_bug(error, debug=debug, as_json=as_json)
        return FAILED


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an unexpected error.")] = False,
) -> None:
    pass


def _run(words: list[str], as_json: bool) -> int:
    if words in (["--version"], ["--version", "--json"]):
        version = metadata.version("fringed")
        print_json({"version": version}) if as_json else print(f"fringed {version}")
        return 0
    try:
        status = int(app(words, prog_name="fringed", standalone_mode=False) or 0)
        return _interrupted(as_json) if status == INTERRUPTED else status  # newer typers return it, older ones raise
    except ScannerError as error:
        return _failed(error, as_json)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        # Whichever argument it was: every look at such a path says so.
        return _failed(StorageError(f"{str(error.filename)[:60]}...: {error.strerror}"), as_json)
    except _UsageError as error:
        context = getattr(error, "ctx", None)
        path = context.command_path if context is not None else "fringed"
        message = error.format_message().removeprefix("Invalid value: ").replace("Value error, ", "")
        if message.startswith("Usage: "):  # a group without a command: its help is the whole answer
            print(message, file=sys.stderr)
        else:
            print_error(message, f"{path} --help")
        if as_json:
            print_failure({"error": {"code": WRONG_USAGE, "message": message, "class": "UsageError"}})
        return WRONG_USAGE
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted(as_json)


def _failed(error: ScannerError, as_json: bool) -> int:
    print_error(str(error), error.hint)
    if as_json:
        print_failure(error_document(error))
    return FAILED


def _interrupted(as_json: bool) -> int:
    print_error("interrupted")
    if as_json:
        print_failure({"error": {"code": INTERRUPTED, "message": "interrupted", "class": "Interrupted"}})
    return INTERRUPTED


def _flushed(status: int) -> int:
    sys.stdout.flush()
    return status


def _output_fault(error: OSError) -> StorageError | None:
    """What is wrong with standard output, if that is where the error comes from."""
    try:
        with storage_errors(Path("cannot write to standard output")):
            sys.stdout.flush()  # what could not be written still waits in there, and fails again
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) and error.filename is None:
                raise error  # with PYTHONUNBUFFERED nothing waits; files of ours have their own errors
    except StorageError as fault:
        return fault
    return None


def _leave_output() -> None:
    """Standard output leads nowhere from now on: Python must not fail there again when it exits."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _report_bug(error: Exception, *, debug: bool, as_json: bool) -> None:
    text = "".join(traceback.format_exception(error))
    message = f"unexpected {type(error).__name__}: {error}"
    if debug:
        print(text, file=sys.stderr)
        print_error(message)
    else:
        descriptor, name = tempfile.mkstemp(prefix="fringed-error-", suffix=".log")
        os.close(descriptor)
        Path(name).write_text(text, encoding="utf-8")
        print_error(message, f"this is a bug; what happened stands in {name} (--debug shows it here)")
    if as_json:
        print_failure({"error": {"code": FAILED, "message": message, "class": type(error).__name__}})
