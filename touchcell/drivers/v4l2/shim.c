/* Makes unmodified programs see an emulated camera (touchcell/drivers/v4l2/emulator/server.py) at /dev/videoN.
 *
 * Preloaded, it takes over opening, stat, ioctl, mmap and close for paths under /dev and /sys/dev/char/81:* that have a
 * counterpart in the folder $TOUCHCELL_V4L2. Everything else goes to libc untouched. Loaded as an ordinary library it
 * offers the same through the touchcell_v4l2_* functions.
 *
 * Opening connects to FOLDER/NAME.sock (SEQPACKET) and receives an errno and two descriptors: a SEQPACKET socket that
 * carries each filled struct v4l2_buffer, and the memory of all buffers. That socket is the descriptor which the program
 * gets, so poll, select and epoll work, and its end of stream is the unplugged camera. As in a kernel, DQBUF and QBUF
 * need no answer from the device; all other requests are sent as {tag, request, struct, pointed-to controls} and
 * answered as {tag, errno, the same}.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <sys/un.h>
#include <unistd.h>

enum { MAX_FD = 4096, MAX_MESSAGE = 8192, MAX_CONTROLS = 128, TIMEOUT_S = 1, VIDEO_MAJOR = 81 };

struct device {
    int control; /* 0: not ours */
    int memory;
    unsigned minor;
    uint32_t tag;
    uint32_t buffers;
    uint32_t stamp_flags;
    int streaming;
    uint8_t queued[VIDEO_MAX_FRAME];
    pthread_mutex_t lock;
};

struct header {
    uint32_t tag;
    uint32_t word; /* request on the way out, errno on the way back */
};

static struct device devices[MAX_FD];

static struct device *device_of(int fd)
{
    return fd >= 0 && fd < MAX_FD && devices[fd].control > 0 ? &devices[fd] : NULL;
}

static int fail(int error)
{
    errno = error;
    return -1;
}

#define REAL(name)                                                                                                     \
    (__extension__({                                                                                                   \
        static __typeof__(&name) real;                                                                                 \
        if (!real)                                                                                                     \
            real = (__typeof__(&name))dlsym(RTLD_NEXT, #name);                                                         \
        real;                                                                                                          \
    }))

/* A socket's path is limited to 107 characters; through /proc/self/fd the folder's length does not count. */
static int connect_to(const char *folder, const char *name)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    struct timeval timeout = {.tv_sec = TIMEOUT_S};
    int directory = REAL(openat)(AT_FDCWD, folder, O_PATH | O_DIRECTORY | O_CLOEXEC);
    int control, refused;
    if (directory < 0)
        return -1;
    snprintf(address.sun_path, sizeof address.sun_path, "/proc/self/fd/%d/%s.sock", directory, name);
    control = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    refused = connect(control, (struct sockaddr *)&address, sizeof address);
    REAL(close)(directory);
    if (refused) {
        REAL(close)(control);
        return fail(ENODEV);
    }
    setsockopt(control, SOL_SOCKET, SO_RCVTIMEO, &timeout, sizeof timeout);
    return control;
}

int touchcell_v4l2_open(const char *folder, const char *name, int flags)
{
    char space[CMSG_SPACE(2 * sizeof(int))];
    struct {
        int32_t error;
        uint32_t minor;
    } greeting;
    struct iovec vector = {&greeting, sizeof greeting};
    struct msghdr message = {
        .msg_iov = &vector, .msg_iovlen = 1, .msg_control = space, .msg_controllen = sizeof space};
    int received[2];
    struct cmsghdr *rights;
    struct device *device;
    int control = connect_to(folder, name);
    if (control < 0)
        return -1;
    if (recvmsg(control, &message, MSG_CMSG_CLOEXEC) != sizeof greeting || !(rights = CMSG_FIRSTHDR(&message))) {
        REAL(close)(control);
        return fail(ENODEV);
    }
    memcpy(received, CMSG_DATA(rights), sizeof received);
    if (greeting.error || received[0] >= MAX_FD) {
        REAL(close)(control);
        REAL(close)(received[0]);
        REAL(close)(received[1]);
        return fail(greeting.error ? greeting.error : EMFILE);
    }
    if (flags & O_NONBLOCK)
        fcntl(received[0], F_SETFL, fcntl(received[0], F_GETFL) | O_NONBLOCK);
    device = &devices[received[0]];
    memset(device, 0, sizeof *device);
    pthread_mutex_init(&device->lock, NULL);
    device->memory = received[1];
    device->minor = greeting.minor;
    device->stamp_flags = V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    __sync_synchronize();
    device->control = control;
    return received[0];
}

int touchcell_v4l2_close(int fd)
{
    struct device *device = device_of(fd);
    if (device) {
        REAL(close)(device->control);
        REAL(close)(device->memory);
        device->control = 0;
    }
    return REAL(close)(fd);
}

int touchcell_v4l2_memory(int fd)
{
    struct device *device = device_of(fd);
    return device ? device->memory : fail(EBADF);
}

static void forget_frames(int fd, struct device *device)
{
    struct v4l2_buffer late;
    while (recv(fd, &late, sizeof late, MSG_DONTWAIT) > 0)
        ;
    memset(device->queued, 0, sizeof device->queued);
}

static int dequeue(int fd, struct device *device, struct v4l2_buffer *wanted)
{
    struct v4l2_buffer filled;
    ssize_t count;
    if (wanted->type != V4L2_BUF_TYPE_VIDEO_CAPTURE || wanted->memory != V4L2_MEMORY_MMAP || !device->streaming)
        return fail(EINVAL);
    count = recv(fd, &filled, sizeof filled, 0);
    if (count < 0)
        return fail(errno == EAGAIN || errno == EINTR ? errno : ENODEV);
    if (count == 2 * sizeof(int32_t)) { /* an error of the transfer */
        int32_t error[2];
        memcpy(error, &filled, sizeof error);
        return fail(error[1]);
    }
    if (count == 1) /* streaming has ended while this thread waited */
        return fail(EINVAL);
    if (count != sizeof filled || filled.index >= VIDEO_MAX_FRAME)
        return fail(ENODEV);
    device->queued[filled.index] = 0;
    *wanted = filled;
    return 0;
}

static int enqueue(struct device *device, struct v4l2_buffer *buffer)
{
    char message[sizeof(struct header) + sizeof *buffer];
    struct header header = {0, VIDIOC_QBUF};
    if (buffer->type != V4L2_BUF_TYPE_VIDEO_CAPTURE || buffer->memory != V4L2_MEMORY_MMAP ||
        buffer->index >= device->buffers || device->queued[buffer->index] ||
        buffer->flags & V4L2_BUF_FLAG_REQUEST_FD)
        return fail(buffer->flags & V4L2_BUF_FLAG_REQUEST_FD ? EBADR : EINVAL);
    memcpy(message, &header, sizeof header);
    memcpy(message + sizeof header, buffer, sizeof *buffer);
    if (send(device->control, message, sizeof message, MSG_NOSIGNAL) != (ssize_t)sizeof message)
        return fail(ENODEV);
    device->queued[buffer->index] = 1;
    buffer->flags = V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_QUEUED | device->stamp_flags;
    return 0;
}

static int readable(const void *where, size_t size)
{
    static __thread char nowhere[MAX_MESSAGE];
    struct iovec local = {nowhere, size}, remote = {(void *)where, size};
    return process_vm_readv(getpid(), &local, 1, &remote, 1, 0) == (ssize_t)size;
}

/* One request and its answer; answers to earlier requests that timed out are skipped. */
static int exchange(struct device *device, uint32_t request, char *message, size_t size)
{
    struct header header = {++device->tag, request};
    ssize_t count;
    memcpy(message, &header, sizeof header);
    if (send(device->control, message, size, MSG_NOSIGNAL) != (ssize_t)size)
        return ENODEV;
    do {
        count = recv(device->control, message, MAX_MESSAGE, 0);
        if (count < 0 && (errno == EAGAIN || errno == EINTR))
            return ETIMEDOUT;
        if (count < (ssize_t)sizeof header)
            return ENODEV;
        memcpy(&header, message, sizeof header);
    } while (header.tag != device->tag);
    return (int)header.word;
}

static void note(int fd, struct device *device, uint32_t request, const void *argument)
{
    if (request == VIDIOC_REQBUFS)
        device->buffers = ((const struct v4l2_requestbuffers *)argument)->count;
    if (request == VIDIOC_QUERYBUF)
        device->stamp_flags = ((const struct v4l2_buffer *)argument)->flags &
                              (V4L2_BUF_FLAG_TIMESTAMP_MASK | V4L2_BUF_FLAG_TSTAMP_SRC_MASK);
    if (request == VIDIOC_STREAMON)
        device->streaming = 1;
    if (request == VIDIOC_STREAMOFF)
        device->streaming = 0;
    if (request == VIDIOC_STREAMOFF || request == VIDIOC_REQBUFS)
        forget_frames(fd, device);
}

int touchcell_v4l2_ioctl(int fd, unsigned long long_request, void *argument)
{
    struct device *device = device_of(fd);
    uint32_t request = (uint32_t)long_request;
    size_t size = _IOC_SIZE(request), extra = 0;
    struct v4l2_ext_controls *list = NULL;
    char message[MAX_MESSAGE];
    char *body = message + sizeof(struct header);
    int error;

    if (!device)
        return fail(EBADF);
    if (_IOC_TYPE(request) != 'V' || size > MAX_MESSAGE / 2)
        return fail(ENOTTY);
    if (size && !readable(argument, size))
        return fail(EFAULT);
    if (request == VIDIOC_DQBUF)
        return dequeue(fd, device, argument);
    if (request == VIDIOC_QBUF)
        return enqueue(device, argument);
    if (request == VIDIOC_G_EXT_CTRLS || request == VIDIOC_S_EXT_CTRLS || request == VIDIOC_TRY_EXT_CTRLS) {
        list = argument;
        if (list->count > MAX_CONTROLS)
            return fail(EINVAL);
        extra = list->count * sizeof(struct v4l2_ext_control);
        if (extra && !readable(list->controls, extra))
            return fail(EFAULT);
    }
    pthread_mutex_lock(&device->lock);
    memcpy(body, argument, size);
    if (extra)
        memcpy(body + size, list->controls, extra);
    error = exchange(device, request, message, sizeof(struct header) + size + extra);
    if (error != ETIMEDOUT && error != ENODEV && error != ENOTTY) {
        struct v4l2_ext_control *controls = list ? list->controls : NULL;
        if (_IOC_DIR(request) & _IOC_READ)
            memcpy(argument, body, size);
        if (list)
            list->controls = controls;
        if (extra)
            memcpy(controls, body + size, extra);
    }
    if (!error)
        note(fd, device, request, argument);
    pthread_mutex_unlock(&device->lock);
    return error ? fail(error) : 0;
}

/* Where an emulated path really leads: 1 a camera (name without folder), 2 a file of its sysfs entry (whole path). */
static int emulated(const char *path, char *found, size_t size)
{
    const char *folder = getenv("TOUCHCELL_V4L2"), *name;
    char candidate[4096];
    static const char sysfs[] = "/sys/dev/char/81:";
    if (!folder || !path)
        return 0;
    if (!strncmp(path, sysfs, sizeof sysfs - 1)) {
        snprintf(candidate, sizeof candidate, "%s/sys/81:%s", folder, path + sizeof sysfs - 1);
        snprintf(found, size, "%s", candidate);
        return access(candidate, F_OK) ? 0 : 2;
    }
    if (strncmp(path, "/dev/", 5))
        return 0;
    name = strrchr(path, '/') + 1;
    snprintf(candidate, sizeof candidate, "%s/%s.sock", folder, name);
    snprintf(found, size, "%s", name);
    return access(candidate, F_OK) ? 0 : 1;
}

static int open_any(int directory, const char *path, int flags, mode_t mode)
{
    char found[4096];
    switch (emulated(path, found, sizeof found)) {
    case 1:
        return touchcell_v4l2_open(getenv("TOUCHCELL_V4L2"), found, flags);
    case 2:
        path = found;
    }
    return REAL(openat)(directory, path, flags, mode);
}

#define OPEN(name, first, directory)                                                                                   \
    int name(first const char *path, int flags, ...)                                                                   \
    {                                                                                                                  \
        mode_t mode = 0;                                                                                               \
        if (flags & (O_CREAT | O_TMPFILE)) {                                                                           \
            va_list rest;                                                                                              \
            va_start(rest, flags);                                                                                     \
            mode = va_arg(rest, mode_t);                                                                               \
            va_end(rest);                                                                                              \
        }                                                                                                              \
        return open_any(directory, path, flags, mode);                                                                 \
    }
#define NOTHING
#define DIRECTORY int directory,
OPEN(open, NOTHING, AT_FDCWD)
OPEN(open64, NOTHING, AT_FDCWD)
OPEN(openat, DIRECTORY, directory)
OPEN(openat64, DIRECTORY, directory)

/* Callers compiled with _FORTIFY_SOURCE open through these. */
int __open_2(const char *path, int flags) { return open_any(AT_FDCWD, path, flags, 0); }
int __open64_2(const char *path, int flags) { return open_any(AT_FDCWD, path, flags, 0); }
int __openat_2(int directory, const char *path, int flags) { return open_any(directory, path, flags, 0); }
int __openat64_2(int directory, const char *path, int flags) { return open_any(directory, path, flags, 0); }

#define FOPEN(name)                                                                                                    \
    FILE *name(const char *path, const char *mode)                                                                     \
    {                                                                                                                  \
        char found[4096];                                                                                              \
        return REAL(name)(emulated(path, found, sizeof found) == 2 ? found : path, mode);                              \
    }
FOPEN(fopen)
FOPEN(fopen64)

static int camera_stat(unsigned minor, struct stat *entry)
{
    memset(entry, 0, sizeof *entry);
    entry->st_mode = S_IFCHR | 0660;
    entry->st_nlink = 1;
    entry->st_rdev = makedev(VIDEO_MAJOR, minor);
    return 0;
}

#define STAT(name, kind)                                                                                               \
    int name(const char *path, struct kind *entry)                                                                     \
    {                                                                                                                  \
        char found[4096];                                                                                              \
        const char *digits;                                                                                            \
        switch (emulated(path, found, sizeof found)) {                                                                 \
        case 1:                                                                                                        \
            digits = strpbrk(found, "0123456789");                                                                     \
            return camera_stat(digits ? (unsigned)atoi(digits) : 0, (struct stat *)entry);                             \
        case 2:                                                                                                        \
            path = found;                                                                                              \
        }                                                                                                              \
        return REAL(name)(path, entry);                                                                                \
    }
STAT(stat, stat)
STAT(stat64, stat64)
STAT(lstat, stat)
STAT(lstat64, stat64)

#define FSTAT(name, kind)                                                                                              \
    int name(int fd, struct kind *entry)                                                                               \
    {                                                                                                                  \
        struct device *device = device_of(fd);                                                                         \
        return device ? camera_stat(device->minor, (struct stat *)entry) : REAL(name)(fd, entry);                      \
    }
FSTAT(fstat, stat)
FSTAT(fstat64, stat64)

int ioctl(int fd, unsigned long request, ...)
{
    va_list rest;
    void *argument;
    va_start(rest, request);
    argument = va_arg(rest, void *);
    va_end(rest);
    return device_of(fd) ? touchcell_v4l2_ioctl(fd, request, argument) : REAL(ioctl)(fd, request, argument);
}

int close(int fd) { return device_of(fd) ? touchcell_v4l2_close(fd) : REAL(close)(fd); }

/* The camera only streams into mapped memory, as its capabilities say. */
ssize_t read(int fd, void *data, size_t size) { return device_of(fd) ? fail(EINVAL) : REAL(read)(fd, data, size); }

ssize_t write(int fd, const void *data, size_t size)
{
    return device_of(fd) ? fail(EINVAL) : REAL(write)(fd, data, size);
}

void *mmap(void *where, size_t length, int protection, int flags, int fd, off_t offset)
{
    struct device *device = device_of(fd);
    return REAL(mmap)(where, length, protection, flags, device ? device->memory : fd, offset);
}

void *mmap64(void *where, size_t length, int protection, int flags, int fd, off64_t offset)
{
    return mmap(where, length, protection, flags, fd, offset);
}
