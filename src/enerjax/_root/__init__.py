"""Roots of functions that are scaled to order one, with their derivatives."""

from .find import find_root as find_root, ROOT as ROOT
from .search import Root as Root, RootFinder as RootFinder
