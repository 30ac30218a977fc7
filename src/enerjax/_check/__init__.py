from .inputs import (
    check_system as check_system,
    positive_integer as positive_integer,
    prepare as prepare,
)
