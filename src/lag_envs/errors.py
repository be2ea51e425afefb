"""The error that commands show as they are."""


class UserError(Exception):
    """A mistake of the user's; its text is shown, without a traceback."""
