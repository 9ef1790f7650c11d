"""The error for a page's message that cannot be done."""


class Refused(Exception):
    """A message of a page cannot be done; the session continues.

    Attributes:
        code: a short word for the page, one of those in docs/play_protocol.md.
        message: one plain line for the person.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
