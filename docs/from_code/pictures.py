"""Pictures drawn while the documentation is built: they go straight into the built pages' folder."""

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Self
from urllib.request import urlopen

from sphinx.environment import BuildEnvironment

FOLDER = "_images"


@dataclass(frozen=True)
class Pictures:
    """Where the pictures of a page go.

    Attributes
    ----------
    folder : Path
    address : str
        Of that folder, seen from the page.
    """

    folder: Path
    address: str

    @classmethod
    def of(cls, env: BuildEnvironment) -> Self:
        """The place for the page that is being read."""
        folder = Path(env.app.outdir) / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        return cls(folder, "../" * env.docname.count("/") + FOLDER)

    def keep(self, name: str, data_address: str, alt: str) -> str:
        """Keep a picture given as a `data:` address; the HTML that shows it."""
        with urlopen(data_address) as picture:
            file = f"{name}.{'png' if picture.headers.get_content_subtype() == 'png' else 'svg'}"
            (self.folder / file).write_bytes(picture.read())
        return f'<img src="{self.address}/{file}" alt="{escape(alt)}" loading="lazy">'
