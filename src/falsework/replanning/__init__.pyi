from falsework.replanning.plan_diff import difference as difference
from falsework.replanning.request import Request as Request
from falsework.replanning.session import ReplanSettings as ReplanSettings
