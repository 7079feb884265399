"""Exceptions -> one-line error messages of the command."""

from __future__ import annotations

#: Exceptions raised by bad input: reported in one line, without a traceback.
USER_ERRORS = (ValueError, OSError, KeyError, ImportError)


def unwrap_cause(error: BaseException) -> BaseException:
    """The exception inside Hydra's InstantiationException; other exceptions unchanged."""
    is_wrapper = type(error).__name__ == "InstantiationException"
    return error.__cause__ if is_wrapper and error.__cause__ else error


def format_error(error: BaseException) -> str:
    """Exception -> message in one line."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    if any(
        "Original Traceback" in line for line in lines
    ):  # a data-loader worker's message contains its whole traceback
        lines = lines[-1:]
    message = " ".join(" ".join(lines).split())
    if type(error).__name__ == "MissingMandatoryValue":
        return f"{getattr(error, 'full_key', '')}: found no value, expected {getattr(error, 'full_key', '')}=VALUE"
    if "hydra/launcher/" in message:
        message += " (launchers are optional extras: pip install 'dhtorch[scale]', for Ray 'dhtorch[ray-launcher]')"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, KeyError) and len(error.args) == 1:
        return str(error.args[0])
    return (
        message if isinstance(error, USER_ERRORS) or is_settings_error(error) else f"{type(error).__name__}: {message}"
    )


def is_settings_error(error: BaseException) -> bool:
    """Whether the error is Hydra's, OmegaConf's or YAML's, whose messages name the option or the file."""
    return type(error).__module__.startswith(("hydra.", "omegaconf.", "yaml."))
