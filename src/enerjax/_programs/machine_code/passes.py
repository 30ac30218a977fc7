"""Passes of a loop that do not depend on one another, on all cores, as code for LLVM.

Threads of XLA take `WIDTH` passes at a time, each with a memory of its own for the numbers
that differ between passes. The thread that asks for them works too, and waits only for
threads that have begun: XLA may have none to lend.
"""

from . import addresses
from .loops import WIDTH


_VECTOR = f"<{WIDTH} x double>"

# Numbers of a job: the next pass, how many passes are done, how many threads hold it, and
# all passes; then the memory and the function for passes from a number on. The offsets in
# structures of XLA are those of `xla/ffi/api/c_api.h`. `$NUMBER$` constants are copied, and
# `$WIDE$` is the size of a memory.
PASSES = f"""
declare i32 @sched_yield()

define internal void @widened(ptr %m, ptr %w, i64 %n) #0 {{
entry:
  br label %head
head:
  %k = phi i64 [ 0, %entry ], [ %next, %body ]
  %more = icmp ult i64 %k, %n
  br i1 %more, label %body, label %end
body:
  %a = getelementptr double, ptr %m, i64 %k
  %x = load double, ptr %a
  %one = insertelement {_VECTOR} poison, double %x, i64 0
  %all = shufflevector {_VECTOR} %one, {_VECTOR} poison, <{WIDTH} x i32> zeroinitializer
  %b = getelementptr {_VECTOR}, ptr %w, i64 %k
  store {_VECTOR} %all, ptr %b, align 8
  %next = add i64 %k, 1
  br label %head
end:
  ret void
}}

define internal ptr @passes_memory() #0 {{
entry:
  %w = call ptr @malloc(i64 $WIDE$)
  %none = icmp eq ptr %w, null
  br i1 %none, label %end, label %found
found:
  %c = {addresses.loaded(addresses.CONSTANTS)}
  call void @widened(ptr %c, ptr %w, i64 $NUMBER$)
  br label %end
end:
  ret ptr %w
}}

define internal void @share(ptr %job, ptr %w) #0 {{
entry:
  %done = getelementptr i64, ptr %job, i64 1
  %a = getelementptr i64, ptr %job, i64 3
  %length = load i64, ptr %a
  %b = getelementptr i64, ptr %job, i64 4
  %m = load ptr, ptr %b
  %c = getelementptr i64, ptr %job, i64 5
  %fn = load ptr, ptr %c
  %last = sub i64 %length, {WIDTH}
  br label %head
head:
  %own = atomicrmw add ptr %job, i64 {WIDTH} seq_cst
  %more = icmp ult i64 %own, %length
  br i1 %more, label %body, label %end
body:
  ; The last passes may overlap those before them, which are made again.
  %short = icmp ult i64 %last, %own
  %first = select i1 %short, i64 %last, i64 %own
  call void %fn(ptr %m, ptr %w, i64 %first)
  %before = atomicrmw add ptr %done, i64 {WIDTH} seq_cst
  br label %head
end:
  ret void
}}

define internal void @release(ptr %job) #0 {{
entry:
  %holders = getelementptr i64, ptr %job, i64 2
  %before = atomicrmw sub ptr %holders, i64 1 seq_cst
  %is_last = icmp eq i64 %before, 1
  br i1 %is_last, label %last, label %end
last:
  call void @free(ptr %job)
  br label %end
end:
  ret void
}}

define internal void @help(ptr %job) #0 {{
entry:
  %next = load atomic i64, ptr %job seq_cst, align 8
  %a = getelementptr i64, ptr %job, i64 3
  %length = load i64, ptr %a
  %more = icmp ult i64 %next, %length
  br i1 %more, label %work, label %end
work:
  %w = call ptr @passes_memory()
  ; Without memory the thread that asked does the work alone.
  %none = icmp eq ptr %w, null
  br i1 %none, label %end, label %begin
begin:
  call void @share(ptr %job, ptr %w)
  call void @free(ptr %w)
  br label %end
end:
  call void @release(ptr %job)
  ret void
}}

define internal void @drop_error(ptr %api, ptr %error) #0 {{
  %args = alloca [3 x ptr]
  store i64 24, ptr %args
  %a = getelementptr ptr, ptr %args, i64 1
  store ptr null, ptr %a
  %b = getelementptr ptr, ptr %args, i64 2
  store ptr %error, ptr %b
  %c = getelementptr ptr, ptr %api, i64 8
  %drop = load ptr, ptr %c
  call void %drop(ptr %args)
  ret void
}}

define internal i64 @num_threads(ptr %api, ptr %context) #0 {{
entry:
  %size = load i64, ptr %api
  %is_known = icmp uge i64 %size, 152
  br i1 %is_known, label %ask, label %none
ask:
  %out = alloca i64
  store i64 0, ptr %out
  %args = alloca [4 x ptr]
  store i64 32, ptr %args
  %a = getelementptr ptr, ptr %args, i64 1
  store ptr null, ptr %a
  %b = getelementptr ptr, ptr %args, i64 2
  store ptr %context, ptr %b
  %c = getelementptr ptr, ptr %args, i64 3
  store ptr %out, ptr %c
  %d = getelementptr ptr, ptr %api, i64 18
  %count = load ptr, ptr %d
  %error = call ptr %count(ptr %args)
  %fails = icmp ne ptr %error, null
  br i1 %fails, label %failed, label %found
failed:
  call void @drop_error(ptr %api, ptr %error)
  br label %none
found:
  %n = load i64, ptr %out
  ret i64 %n
none:
  ret i64 1
}}

define internal void @ask_for_help(ptr %api, ptr %context, ptr %job) #0 {{
entry:
  %args = alloca [5 x ptr]
  store i64 40, ptr %args
  %a = getelementptr ptr, ptr %args, i64 1
  store ptr null, ptr %a
  %b = getelementptr ptr, ptr %args, i64 2
  store ptr %context, ptr %b
  %c = getelementptr ptr, ptr %args, i64 3
  store ptr @help, ptr %c
  %d = getelementptr ptr, ptr %args, i64 4
  store ptr %job, ptr %d
  %e = getelementptr ptr, ptr %api, i64 17
  %schedule = load ptr, ptr %e
  %error = call ptr %schedule(ptr %args)
  %fails = icmp ne ptr %error, null
  br i1 %fails, label %failed, label %end
failed:
  call void @drop_error(ptr %api, ptr %error)
  call void @release(ptr %job)
  br label %end
end:
  ret void
}}

define internal void @passes(ptr %frame, ptr %m, ptr %w, ptr %fn, i64 %length) #0 {{
entry:
  %f0 = getelementptr ptr, ptr %frame, i64 2
  %api = load ptr, ptr %f0
  %f1 = getelementptr ptr, ptr %frame, i64 3
  %context = load ptr, ptr %f1
  %threads = call i64 @num_threads(ptr %api, ptr %context)
  %rounded = add i64 %length, {WIDTH - 1}
  %groups = udiv i64 %rounded, {WIDTH}
  %few = icmp slt i64 %threads, %groups
  %most = select i1 %few, i64 %threads, i64 %groups
  %some = icmp sgt i64 %most, 1
  %holding = select i1 %some, i64 %most, i64 1
  %job = call ptr @malloc(i64 48)
  store i64 0, ptr %job
  %done = getelementptr i64, ptr %job, i64 1
  store i64 0, ptr %done
  %j2 = getelementptr i64, ptr %job, i64 2
  store i64 %holding, ptr %j2
  %j3 = getelementptr i64, ptr %job, i64 3
  store i64 %length, ptr %j3
  %j4 = getelementptr i64, ptr %job, i64 4
  store ptr %m, ptr %j4
  %j5 = getelementptr i64, ptr %job, i64 5
  store ptr %fn, ptr %j5
  fence seq_cst
  br label %head
head:
  %k = phi i64 [ 1, %entry ], [ %next, %body ]
  %more = icmp ult i64 %k, %holding
  br i1 %more, label %body, label %work
body:
  call void @ask_for_help(ptr %api, ptr %context, ptr %job)
  %next = add i64 %k, 1
  br label %head
work:
  call void @share(ptr %job, ptr %w)
  br label %wait
wait:
  %now = load atomic i64, ptr %done seq_cst, align 8
  %ready = icmp uge i64 %now, %length
  br i1 %ready, label %end, label %again
again:
  %ignored = call i32 @sched_yield()
  br label %wait
end:
  call void @release(ptr %job)
  ret void
}}
"""
