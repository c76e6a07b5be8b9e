"""RoboSense lidars."""
