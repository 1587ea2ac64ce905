"""The one exception that users are meant to read."""


class LidarpoolError(Exception):
    """Something the user can put right: bad input, a missing partition, a full disk.

    The message is one or two lines that say what was given, what was expected and what to
    do. The command prints it without a traceback and exits with code 2.
    """
