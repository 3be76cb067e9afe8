from falsework.service.server import run_service as run_service
from falsework.service.settings import ServiceSettings as ServiceSettings
