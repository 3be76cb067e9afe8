// Kernel entry points. `PART` leaves all but one out, since each takes seconds to compile.

#if !defined(PART) || PART == 0
KERNEL((ADMM_THREADS, ADMM_BLOCKS)) admm_shared(Structure s, Options o, Batch b) { run_admm<true>(s, o, b); }
#endif
#if !defined(PART) || PART == 1
KERNEL((ADMM_THREADS, 1)) admm_scratch(Structure s, Options o, Batch b) { run_admm<false>(s, o, b); }
#endif
#if !defined(PART) || PART == 2
KERNEL((INTERIOR_THREADS, INTERIOR_BLOCKS)) interior_shared(Structure s, Options o, Batch b) { run_interior<true>(s, o, b); }
#endif
#if !defined(PART) || PART == 3
KERNEL((INTERIOR_THREADS, 1)) interior_scratch(Structure s, Options o, Batch b) { run_interior<false>(s, o, b); }
#endif
#if !defined(PART) || PART == 4
KERNEL((CONTACT_THREADS, CONTACT_BLOCKS)) contact_shared(Structure s, Options o, Batch b) { run_contact_shared(s, o, b); }
#endif
#if !defined(PART) || PART == 5
KERNEL((CONTACT_THREADS, 1)) contact_scratch(Structure s, Options o, Batch b) { run_contact_scratch(s, o, b); }
#endif
