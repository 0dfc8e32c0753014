"""The optional packages of the public models, imported where they are first needed."""

from functools import partial

from wm_nodes.core.imports import optional_package

package = partial(optional_package, needed_by="public video models need", requirements="video.txt")
