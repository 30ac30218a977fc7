from .inputs import (
    check_halvings as check_halvings,
    check_system as check_system,
    positive_integer as positive_integer,
    prepare as prepare,
)
