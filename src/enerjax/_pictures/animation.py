"""Pictures that move: files, and a player in notebooks."""

import base64
import contextlib
import io
import itertools
import shutil
import subprocess
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image


# More frames than this are a mistake: ten minutes of a film.
_MOST_FRAMES = 15_000
# Of the 256 colours of a file, so many are exact.
_EXACT = 160


def frame_times(first: float, last: float, speed: float, fps: float) -> np.ndarray:
    """The times that the frames show, from `first` to `last`.

    **Raises:** `ValueError` for numbers that are not positive, and for a run that gives
    less than two frames, or far too many.
    """
    for name, value in (("speed", speed), ("fps", fps)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"`{name}` must be positive, got {value}.")
    seconds = (last - first) / speed
    count = int(np.floor(seconds * fps + 1e-9)) + 1
    if last == first:
        raise ValueError(
            f"There is one row that the run reached, t = {first:.6g}: nothing moves. Draw "
            "it with `scene.draw`."
        )
    if not 2 <= count <= _MOST_FRAMES:
        what = "less than two frames" if count < 2 else f"{count} frames"
        raise ValueError(
            f"The run lasts {last - first:.4g} units of time, which are {seconds:.4g} "
            f"seconds of film at `speed={speed:g}`: {what}. For ten seconds pass "
            f"`speed={(last - first) / 10:.2g}`."
        )
    times = np.minimum(first + np.arange(count) * speed / fps, last)
    # The end is shown too, for less than a frame.
    return np.append(times, last) if last - times[-1] > 1e-6 * speed / fps else times


class Animation:
    """A film of a run, which notebooks show as a player.

    `save("run.gif")` writes a file; `show(k)` draws frame `k` into `figure`, for a picture
    of it.

    - `figure`: of matplotlib.
    - `ts`: the times of the frames, shape `(frames,)`.
    - `fps`: frames per second.
    """

    def __init__(
        self,
        figure: Any,
        ts: np.ndarray,
        fps: float,
        show: Callable[[int], None],
        moving: Sequence[Artist],
    ):
        self.figure: Figure = figure
        self.ts, self.fps, self.show = ts, fps, show
        self._moving = moving
        show(0)
        for _ in range(2):  # the first layout does not know the labels of equal axes
            figure.draw_without_rendering()
        # What a layout engine moves from frame to frame would tremble.
        figure.set_layout_engine("none")

    def save(self, path: str | Path, dpi: float = 100) -> Path:
        """Writes a GIF, an MP4 or an HTML file, by its suffix, and returns its path.

        MP4 needs the program ffmpeg.

        **Raises:** `ValueError` for another suffix, `RuntimeError` without ffmpeg, and if
        it fails.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in (".gif", ".mp4", ".html"):
            raise ValueError(
                f"A film is saved as .gif, .mp4 or .html, got '{path.name}'. For a picture "
                "of one frame take `show(k)` and `figure.savefig`."
            )
        if suffix == ".mp4" and shutil.which("ffmpeg") is None:
            raise RuntimeError(
                "MP4 needs the program ffmpeg, which is not found on this machine: install "
                f"it, or save '{path.with_suffix('.gif').name}'."
            )
        if suffix == ".gif":
            self._save_gif(path, dpi)
        elif suffix == ".mp4":
            self._save_mp4(path, dpi)
        else:
            path.write_text(f"<!DOCTYPE html>\n{self._player(dpi)}")
        return path

    def _repr_html_(self) -> str:
        """A player, whose frames are part of the page."""
        return self._player(self.figure.dpi)

    def __repr__(self) -> str:
        seconds = len(self.ts) / self.fps
        return (
            f"Animation of t = {self.ts[0]:.4g} to {self.ts[-1]:.4g} in {seconds:.3g} s "
            f"({len(self.ts)} frames): save it with `.save('run.gif')`."
        )

    def _frames(self, dpi: float) -> list[Image.Image]:
        """All frames, with a palette that they share."""
        count = len(self.ts)
        palette = _palette(list(self._rendered((0, count // 2, count - 1), dpi)))
        return [
            Image.fromarray(x).quantize(palette=palette, dither=Image.Dither.NONE)
            for x in self._rendered(range(count), dpi)
        ]

    def _rendered(self, numbers: Sequence[int], dpi: float) -> Iterator[np.ndarray]:
        """The colours of some frames. What does not move is drawn once: most of the time
        goes into ticks and labels."""
        before = self.figure.dpi
        canvas: Any = FigureCanvasAgg(self.figure)
        self.figure.set_dpi(dpi)
        for artist in self._moving:
            artist.set_animated(True)
        try:
            canvas.draw()
            still = canvas.copy_from_bbox(self.figure.bbox)
            for k in numbers:
                self.show(k)
                canvas.restore_region(still)
                for artist in sorted(self._moving, key=lambda x: x.get_zorder()):
                    if hasattr(artist, "do_3d_projection"):
                        artist.do_3d_projection()  # pyright: ignore
                    artist.draw(canvas.get_renderer())
                yield np.array(np.asarray(canvas.buffer_rgba())[..., :3])
        finally:
            for artist in self._moving:
                artist.set_animated(False)
            self.figure.set_dpi(before)

    def _save_gif(self, path: Path, dpi: float) -> None:
        """GIFs have times in hundredths of a second: each frame is rounded so that the
        whole is right."""
        frames = self._frames(dpi)
        ends = np.round(100 * np.arange(1, len(frames) + 1) / self.fps)
        durations = 10 * np.maximum(np.diff(ends, prepend=0), 1).astype(int)
        first, *others = frames
        first.save(
            path, save_all=True, append_images=others, duration=durations.tolist(), loop=0
        )

    def _save_mp4(self, path: Path, dpi: float) -> None:
        frames = self._rendered(range(len(self.ts)), dpi)
        first = next(frames)
        height, width, _ = first.shape
        size, form = f"{width}x{height}", ["-f", "rawvideo", "-pix_fmt", "rgb24"]
        even = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
        source = [*form, "-s", size, "-r", str(self.fps), "-i", "pipe:0"]
        with subprocess.Popen(
            ["ffmpeg", "-y", "-loglevel", "error", *source, *even, str(path)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as ffmpeg:
            # It says why when it ends, whether or not it took the frames.
            with contextlib.suppress(BrokenPipeError):
                for frame in itertools.chain([first], frames):
                    ffmpeg.stdin.write(frame)  # pyright: ignore[reportOptionalMemberAccess]
            _, errors = ffmpeg.communicate()
        if ffmpeg.returncode != 0:
            raise RuntimeError(f"ffmpeg could not write {path}: {errors.decode().strip()}")

    def _player(self, dpi: float) -> str:
        sources = []
        for frame in self._frames(dpi):
            file = io.BytesIO()
            frame.save(file, "png", optimize=True)
            sources.append(base64.b64encode(file.getvalue()).decode())
        return _PLAYER.format(
            name=f"film{uuid.uuid4().hex}",
            last=len(sources) - 1,
            frames=",".join(f'"{x}"' for x in sources),
            milliseconds=1000 / self.fps,
        )


def _palette(pictures: list[np.ndarray]) -> Image.Image:
    """A palette of the most frequent colours of some pictures, which are those of areas,
    and of means of the others, which are those of blurred edges."""
    pixels = np.concatenate([x.reshape(-1, 3) for x in pictures]).astype(int)
    weights = np.array([1 << 16, 1 << 8, 1])
    codes, counts = np.unique((pixels * weights).sum(axis=1), return_counts=True)
    codes = codes[np.argsort(-counts, kind="stable")]
    # Pillow does not tell colours in a cell of eight levels apart: the first counts.
    codes = codes[np.sort(np.unique(codes & 0xF8F8F8, return_index=True)[1])]
    colors = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=1).astype(np.uint8)
    exact, others = colors[:_EXACT], colors[_EXACT:]
    table = exact.ravel().tolist()
    if len(others):
        means = Image.fromarray(others[None]).quantize(256 - _EXACT).getpalette() or []
        table += means[: 3 * (256 - _EXACT)]
    palette = Image.new("P", (1, 1))
    palette.putpalette(table)
    return palette


_PLAYER = """<div id="{name}">
<img style="max-width:100%"><br>
<button>pause</button>
<input type="range" min="0" max="{last}" value="0" style="width:60%">
<script>
(function() {{
  const box = document.getElementById("{name}");
  const [image, button, slider] = ["img", "button", "input"].map(
    (kind) => box.querySelector(kind));
  const frames = [{frames}].map((x) => "data:image/png;base64," + x);
  let playing = true;
  function show() {{ image.src = frames[slider.valueAsNumber]; }}
  button.onclick = () => {{
    playing = !playing;
    button.textContent = playing ? "pause" : "play";
  }};
  slider.oninput = () => {{ if (playing) button.onclick(); show(); }};
  show();
  const timer = setInterval(() => {{
    if (!document.body.contains(box)) clearInterval(timer);
    if (playing) {{ slider.value = (slider.valueAsNumber + 1) % frames.length; show(); }}
  }}, {milliseconds});
}})();
</script>
</div>"""
