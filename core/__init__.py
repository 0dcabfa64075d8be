"""From a photo and its regions to tileable SVBRDF materials; nothing here but `nodes` knows Blender."""
