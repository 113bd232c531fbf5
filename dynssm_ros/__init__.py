"""Vehicle dynamics for autonomous racing: learned from rosbags, deployed on ROS 2, explained in physical terms.

The rooms, lowest first: ``vehicle`` (physics), ``signals`` (bags, messages, time grids), ``learning`` (models and
training), ``runtime`` (the deployed predictor), ``simulation`` (cars on tracks), ``evaluation`` (tables, figures),
``nodes`` (ROS 2), ``cli`` (the ``dynssm`` command). Imports run downwards only.
"""

__version__ = "0.1.0"
