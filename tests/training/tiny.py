"""A run of seconds."""

from stereokit.training import Recipe

TINY = Recipe.from_dict(
    {
        "name": "tiny",
        "about": "for tests",
        "model": {"name": "coex", "max_disparity": 32},
        "scenes": {"size": [48, 80], "max_disparity": 16, "count": 50},
        "augmentation": {"crop_height": 32, "crop_width": 64, "flip": 0.5},
        "schedule": {"batch": 2, "steps": 6, "milestones": [0.5]},
        "averaging": {"kind": "ema", "decay": 0.5},
    }
)
