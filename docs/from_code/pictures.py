"""Pictures drawn while the documentation is built, written to the folder of the built pages."""

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Self
from urllib.request import urlopen

from sphinx.environment import BuildEnvironment

FOLDER = "_images"


@dataclass(frozen=True)
class Pictures:
    """Folder for the pictures of a page.

    Attributes
    ----------
    folder : Path
    address : str
        Address of the folder relative to the page.
    """

    folder: Path
    address: str

    @classmethod
    def of(cls, env: BuildEnvironment) -> Self:
        """Folder for the pictures of the page that Sphinx reads."""
        folder = Path(env.app.outdir) / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        return cls(folder, "../" * env.docname.count("/") + FOLDER)

    def keep(self, name: str, data_address: str, alt: str) -> str:
        """HTML that shows a picture, which is written to the folder from its `data:` address."""
        with urlopen(data_address) as picture:
            file = f"{name}.{'png' if picture.headers.get_content_subtype() == 'png' else 'svg'}"
            (self.folder / file).write_bytes(picture.read())
        return f'<img src="{self.address}/{file}" alt="{escape(alt)}" loading="lazy">'
