"""A figure of matplotlib that a notebook shows, whether pyplot was imported or not."""

from io import BytesIO

from matplotlib.figure import Figure


class NotebookFigure(Figure):
    """A figure that draws itself where it is the last line of a notebook's cell."""

    def _repr_png_(self) -> bytes:
        image = BytesIO()
        self.savefig(image, format="png")
        return image.getvalue()
