"""A data set made of whatever a test wants."""


class ListDataset:
    """Sweeps from a list; an exception in it is raised when its turn comes."""

    name = "list"
    sensor: dict[str, object] = {}  # noqa: RUF012
    imu = None
    truth = None

    def __init__(self, items):
        self.items = items

    def __len__(self):
        return len(self.items)

    def __iter__(self):
        for item in self.items:
            if isinstance(item, BaseException):
                raise item
            yield item

    def info(self):
        raise NotImplementedError
