/* fsync and fdatasync that fail with EIO as a broken disk's do. Preloaded into a process:

   FAULT_SYNC      a file; while it is there, syncs of files whose path begins with its content fail
   FAULT_SYNC_LOG  a file that gets a line "ok PATH" or "failed PATH" for each sync */

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

static int is_below(const char *path)
{
    char prefix[PATH_MAX];
    int control = open(getenv("FAULT_SYNC"), O_RDONLY | O_CLOEXEC);
    ssize_t size;

    if (control < 0)
        return 0;
    size = read(control, prefix, sizeof prefix);
    close(control);
    return size > 0 && strncmp(path, prefix, (size_t)size) == 0;
}

static int synced(int file, long call)
{
    char link[64], path[PATH_MAX], line[PATH_MAX + 16];
    ssize_t size;
    int log, result = -1;

    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    size = readlink(link, path, sizeof path - 1);
    path[size < 0 ? 0 : size] = '\0';
    errno = EIO;
    if (!is_below(path))
        result = (int)syscall(call, file);
    size = snprintf(line, sizeof line, "%s %s\n", result == 0 ? "ok" : "failed", path);
    log = open(getenv("FAULT_SYNC_LOG"), O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
    if (log >= 0) {
        if (write(log, line, (size_t)size) != size)
            abort();
        close(log);
    }
    if (result != 0)
        errno = EIO;
    return result;
}

int fsync(int file)
{
    return synced(file, SYS_fsync);
}

int fdatasync(int file)
{
    return synced(file, SYS_fdatasync);
}
