"""From a sweep to features: rings, edges, planes, poles, and the motion within the sweep."""
