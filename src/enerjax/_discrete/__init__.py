from .base import AbstractDerivative as AbstractDerivative
from .corrected import Gonzalez as Gonzalez, MeanValue as MeanValue
