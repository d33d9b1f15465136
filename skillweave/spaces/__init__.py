"""Gymnasium spaces to arrays and tensors, and back, for learning.

Begin with ``packing``: it makes one array of a batch of observations. ``ObsCodec`` makes inputs of
networks of it, ``ActionCodec`` converts actions of a policy to the environment's.
"""

from skillweave.spaces.action_codec import (
    ActionCodec,
    JointCodec,
    action_codec,
    choice_counts,
    is_continuous,
)
from skillweave.spaces.choices import (
    ChoiceCodec,
    ChoiceSpace,
    NumberedChoiceCodec,
    choice_codec,
    numbered_choice_codec,
)
from skillweave.spaces.observations import ObsCodec, obs_codec, to_tensor
from skillweave.spaces.packing import leaves, obs_dtype, obs_shape, pack, put_observation, unpack
from skillweave.spaces.saving import other_bounds, same_space, space_from_json, space_to_json

__all__ = [
    "ActionCodec",
    "ChoiceCodec",
    "ChoiceSpace",
    "JointCodec",
    "NumberedChoiceCodec",
    "ObsCodec",
    "action_codec",
    "choice_codec",
    "choice_counts",
    "is_continuous",
    "leaves",
    "numbered_choice_codec",
    "obs_codec",
    "obs_dtype",
    "obs_shape",
    "other_bounds",
    "pack",
    "put_observation",
    "same_space",
    "space_from_json",
    "space_to_json",
    "to_tensor",
    "unpack",
]
