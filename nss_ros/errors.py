"""Errors that a user can cause and mend.

Every message is one sentence that names the thing and the mend; the command line prints it
without a traceback and exits with 1.
"""


class NssError(Exception):
    """Base of all errors that are reported to the user rather than raised as a bug."""


class InputError(NssError):
    """An argument, an id or an array is not usable."""


class ConfigError(NssError):
    """A configuration file, an option or a ROS parameter is not valid."""


class FormatError(NssError):
    """A file is not of the format it should have."""


class BagError(FormatError):
    """A bag or log cannot be read or written, or lacks what is needed."""


class MethodError(NssError):
    """A registration or multi-way method is unknown, or lacks something that it needs."""


class RunError(NssError):
    """A run of the ROS graph failed: a node died, or time ran out."""


class NodeError(RunError):
    """A node died; the message names it and where its output lies."""


class WorkerDiedError(RunError):
    """A process that computed was killed or crashed."""
