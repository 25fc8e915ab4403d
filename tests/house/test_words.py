"""The field's words: what an engineer would have to learn first is not written anywhere."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SUFFIXES = (".py", ".md", ".j2", ".yaml", ".toml", ".css")

PRIVATE_WORDS: dict[str, str] = {
    r"told|tells? of|foretell\w*|foretold|befall\w*|heard|unheard": "measured, commanded, reported",
    r"said(?!\w)": "reported, shown, stated",
    r"wanted": "desired, reference, required",
    r"rims?": "wheel circumferential speed, wheel speed",
    r"the ground of now|what the ground is": "current terrain",
    r"had no say|say in it|let go|let_go": "held out, freed",
    r"held to (?:its|the) (?:way|heading|path)": "with path tracking",
    r"(?:does|do|did) not belong": "excluded",
    r"taught|teach\w*|untaught": "trained",
    r"calm\w*|wild\w*": "steady, transient, low-pass filtered",
    r"swells?|felt|unfelt": "undulation, effective",
    r"(?:steering|steer|leg)[ _]play\w*|play of the": "backlash",
    r"ours": "the controller's name, this project",
    r"(?<!another )days?": "seeds, trials",
    r"(?<!motor[ _])drivers?": "controllers",
    r"nobody": "no measurement, nothing, unknown",
    r"unsure|surer|sure(?! that)": "certain",
    r"sizes of currents|currents (?:are|that are) sizes": "magnitudes",
    r"ways?(?!points?)": "distance travelled, heading, path, direction",
}
"""Word that is not used: what is written in its place.  Whole words, in any case."""

ANY_PRIVATE_WORD = re.compile(rf"(?<![A-Za-z])(?:{'|'.join(PRIVATE_WORDS)})(?![A-Za-z])", re.IGNORECASE)

ALLOWED: dict[str, tuple[str, ...]] = {
    "tests/terrain/effects/test_catalogue.py": ("steering_play=0.01",),
    "data/effects/library.yaml": ("[steering_play]", "[steering_play_rad]"),
    "README.md": ("told:NAME",),
    "CHANGELOG.md": ("told:NAME", "`steering_play`", "`ours`", "`taught_runs`", "`felt_ratio`"),
    "tests/terrain/extension/test_description.py": ('"steering_play"', "steering_play_rad"),
}
"""By file, texts in which such a word is a name that earlier releases accepted, or a title."""

SELF = ("tests/house/test_words.py", "docs/glossary.md")


def private_words(text: str) -> list[tuple[int, str]]:
    """Return each private word of a text, with the number of its line."""
    return [(text.count("\n", 0, it.start()) + 1, it.group(0)) for it in ANY_PRIVATE_WORD.finditer(text)]


def tracked_files() -> list[str]:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:  # a copy of a commit without its history
        names = [str(path.relative_to(ROOT)) for path in ROOT.rglob("*") if path.is_file()]
        return [name for name in names if not name.startswith((".", "build/", "dist/"))]
    return listed.stdout.split()


def test_no_private_word_is_written():
    found = []
    for name in tracked_files():
        if not name.endswith(SUFFIXES) or name in SELF or "/expected/" in name:
            continue
        text = (ROOT / name).read_text(encoding="utf-8")
        for allowed in ALLOWED.get(name, ()):
            text = text.replace(allowed, "")
        found += [f"{name}:{number}: {word}" for number, word in private_words(text)]
    assert found == [], f"{len(found)} private words"


@pytest.mark.parametrize(
    "text", ["as it was told", "the rim speed", "wanted_mps", "20 days", "the way after 5 s"]
)
def test_a_private_word_is_found(text):
    assert private_words(text)
