"""Proved bounds of programs over boxes: affine forms, an interpreter, and covers."""

from sfkd_jax.enclosures._covers import Boxes as Boxes
from sfkd_jax.enclosures._covers import CoverRefused as CoverRefused
from sfkd_jax.enclosures._covers import Question as Question
from sfkd_jax.enclosures._covers import check_cover as check_cover
from sfkd_jax.enclosures._covers import in_parts as in_parts
from sfkd_jax.enclosures._covers import levels as levels
from sfkd_jax.enclosures._covers import norms as norms
from sfkd_jax.enclosures._forms import Form as Form
from sfkd_jax.enclosures._forms import constant as constant
from sfkd_jax.enclosures._forms import of_boxes as of_boxes
from sfkd_jax.enclosures._forms import variables as variables
from sfkd_jax.enclosures._programs import Program as Program
from sfkd_jax.enclosures._programs import program as program
from sfkd_jax.enclosures._reading import UnknownPrimitive as UnknownPrimitive
from sfkd_jax.enclosures._search import Found as Found
from sfkd_jax.enclosures._search import search_cover as search_cover
