from .orders import order_table as order_table, OrderTable as OrderTable
from .precision import work_precision as work_precision, WorkPrecision as WorkPrecision
