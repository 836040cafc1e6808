"""Runs the notebooks and keeps their outputs: python notebooks/run.py [01_nero_lift ...], with the extra ``dev``.

It drops what differs from run to run (progress lines, times), so a change of the outputs is a change of what they show.
"""

import base64
import io
import pathlib
import re
import sys
import tempfile

import nbclient
import nbformat
from PIL import Image

HERE = pathlib.Path(__file__).parent
_TIMES = re.compile(r"^(first|second) call.*\n|^.*steps/s.*\n", re.MULTILINE)


def run(path: pathlib.Path) -> None:
    """Executes a notebook in an empty folder and writes it back."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        nbclient.NotebookClient(notebook, timeout=1200, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # when it ran
        if cell.cell_type == "code":
            cell.outputs = [output for output in map(kept, cell.outputs) if output]
    nbformat.write(notebook, path)
    print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


def kept(output: nbformat.NotebookNode) -> nbformat.NotebookNode | None:
    """Returns the part of an output to keep, pictures and printed text; None: nothing."""
    if output.output_type == "stream":
        output.text = _TIMES.sub("", output.text)
        return output if output.name == "stdout" and output.text.strip() else None
    if "image/png" not in output.get("data", {}):
        return None
    output.data = {"image/png": small(output.data["image/png"])}
    output.metadata = {}
    return output


def small(png: str) -> str:
    """Returns the picture in 256 colours, a third of its bytes. Small details keep their colours."""
    picture, out = Image.open(io.BytesIO(base64.b64decode(png))), io.BytesIO()
    picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=4).save(out, "PNG", optimize=True)
    return base64.b64encode(out.getvalue()).decode()


if __name__ == "__main__":
    for found in sorted(HERE.glob("*.ipynb")):
        if found.stem in (sys.argv[1:] or [found.stem]):
            run(found)
