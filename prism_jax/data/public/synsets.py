"""Names of ShapeNet's 55 categories by their WordNet synset.

Source: Chang et al., "ShapeNet: An Information-Rich 3D Model Repository", 2015.
"""

import json

from prism_jax.assets import asset

SYNSETS: dict[str, str] = json.loads(asset("shapenet_synsets.json").read_text())
