"""What went wrong, in one line: an error of the input, of the settings, of a worker or of a launcher."""

from __future__ import annotations

#: What bad input raises: reported in one line, without a traceback.
USER_ERRORS = (ValueError, OSError, KeyError, ImportError)


def unwrap_cause(error: BaseException) -> BaseException:
    """What a part of the settings raised while Hydra built it."""
    named = type(error).__name__ == "InstantiationException"
    return error.__cause__ if named and error.__cause__ else error


def format_error(error: BaseException) -> str:
    """An error in one line."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    if any("Original Traceback" in line for line in lines):  # a data-loader worker sends its whole traceback along
        lines = lines[-1:]
    message = " ".join(" ".join(lines).split())
    if type(error).__name__ == "MissingMandatoryValue":
        return f"{getattr(error, 'full_key', '')}: found no value, expected {getattr(error, 'full_key', '')}=VALUE"
    if "hydra/launcher/" in message:
        message += " (launchers come with the extras: pip install 'dhtorch[scale]', for Ray 'dhtorch[ray-launcher]')"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, KeyError) and len(error.args) == 1:
        return str(error.args[0])
    return (
        message if isinstance(error, USER_ERRORS) or _is_settings_error(error) else f"{type(error).__name__}: {message}"
    )


def _is_settings_error(error: BaseException) -> bool:
    """What Hydra says of settings names the option itself."""
    return type(error).__module__.startswith(("hydra.", "omegaconf."))
