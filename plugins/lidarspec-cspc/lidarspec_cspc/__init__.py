"""CSPC lidars."""
