"""The one error that is shown to a person as a message, without a traceback."""


class UserError(Exception):
    """Something a person gave is unusable.

    The message names the file or field, what was expected, and what would be valid. The command line
    prints it and exits with 2; the page shows it and keeps the last good state.
    """
