from .inputs import (
    check_halvings as check_halvings,
    positive_integer as positive_integer,
    prepare as prepare,
)
from .system import check_system as check_system
from .times import (
    bound_on_steps as bound_on_steps,
    check_form as check_form,
    check_times as check_times,
)
