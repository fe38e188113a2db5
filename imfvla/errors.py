"""The one error type that users see: it names the thing, what was wanted, what was found and the remedy."""


class UserError(ValueError):
    """A mistake that the user can mend. Entry points print its text alone and exit with status 2.

    The text is one sentence or two: the key or file, what was wanted, what was found, the remedy.
    """
