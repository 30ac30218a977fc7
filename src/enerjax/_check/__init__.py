from .inputs import (
    check_halvings as check_halvings,
    check_system as check_system,
    positive_integer as positive_integer,
    prepare as prepare,
)
from .times import (
    bound_on_steps as bound_on_steps,
    check_form as check_form,
    check_times as check_times,
)
