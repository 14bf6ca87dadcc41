/* For LD_PRELOAD of User Mode Linux 6.1 on processors with AMX, where its guest dies at once without it.
 *
 * That kernel keeps 2696 bytes of extended registers per process, which is all up to AVX-512, and hands so many to
 * PTRACE_SETREGSET. Linux takes all of them or none, and with AMX there are 11008. What is left out is filled in here
 * as the traced process has it: the tiles of AMX, which no process may use without asking, and no guest asks.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

#define ENOUGH 65536

long ptrace(enum __ptrace_request request, ...)
{
	static long (*next)(int, int, void *, void *);
	static char whole[ENOUGH] __attribute__((aligned(64)));
	va_list arguments;

	va_start(arguments, request);
	int process = va_arg(arguments, int);
	void *address = va_arg(arguments, void *);
	void *data = va_arg(arguments, void *);
	va_end(arguments);
	if (next == NULL)
		next = (long (*)(int, int, void *, void *))dlsym(RTLD_NEXT, "ptrace");

	if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE) {
		struct iovec *given = data, all = {whole, sizeof(whole)};
		if (next(PTRACE_GETREGSET, process, address, &all) == 0 && all.iov_len > given->iov_len) {
			memcpy(whole, given->iov_base, given->iov_len);
			return next(request, process, address, &all);
		}
	}
	return next(request, process, address, data);
}
