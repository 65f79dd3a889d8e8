"""A test kit for barriers: `check_barrier(barrier)` tries all that an observer takes a barrier's word for.

An observer reads motions through the rows of barriers that it did not write. It never loses the true parameter if they
keep these promises, each of which is a function:

    check_labels      every row has a name
    check_padding     a body that is absent has no influence, and its row is 0.u <= 1
    check_batch       a robot's rows do not depend on its place in a batch
    check_errors      an active row is measured no further off than `errors` says
    check_left_out    the row of a body without a slot has at least the slack `slack_left_out`
    check_soundness   the true parameter is in the set that a measurement gives, and no alarm is false
    check_compiled    compiled code reads the rows as torch does
    check_derivative  the rows say dh/dt >= -alpha(h), by finite differences
"""

from torchfsid.testing.barriers import check_barrier as check_barrier
from torchfsid.testing.barriers import check_batch as check_batch
from torchfsid.testing.barriers import check_compiled as check_compiled
from torchfsid.testing.barriers import check_derivative as check_derivative
from torchfsid.testing.barriers import check_errors as check_errors
from torchfsid.testing.barriers import check_labels as check_labels
from torchfsid.testing.barriers import check_left_out as check_left_out
from torchfsid.testing.barriers import check_padding as check_padding
from torchfsid.testing.barriers import check_soundness as check_soundness
from torchfsid.testing.situations import first_order as first_order
from torchfsid.testing.situations import random_situations as random_situations
from torchfsid.testing.situations import second_order as second_order
