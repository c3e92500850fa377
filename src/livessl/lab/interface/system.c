/* Preloaded into a program, it replaces the machine's sound cards by the virtual interfaces in a folder.
 *
 * The folder $LIVESSL_INTERFACES holds card0, card1, …, each with the files "name" and "control" (see pcm.c), and
 * proc/asound and sys/class/sound, which are read in place of the kernel's. The card's `hw:K,0` is `pcm.cardK` of the
 * ALSA configuration. A card whose control file says "gone" is not listed.
 */
#define _GNU_SOURCE
#include <alsa/asoundlib.h>
#include <dlfcn.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

static char card_name[80];

static int plain_open(const char *path, int flags, mode_t mode)
{
    static int (*real)(const char *, int, ...);
    if (!real)
        real = (int (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open64");
    return real(path, flags, mode);
}

/* Reads a file of a card; returns whether it could. */
static int read_of(int card, const char *file, char *text, size_t size)
{
    const char *folder = getenv("LIVESSL_INTERFACES");
    char path[500];
    snprintf(path, sizeof path, "%s/card%d/%s", folder ? folder : "/nonexistent", card, file);
    int fd = plain_open(path, O_RDONLY | O_CLOEXEC, 0);
    ssize_t length = fd < 0 ? -1 : read(fd, text, size - 1);
    if (fd >= 0)
        close(fd);
    text[length < 0 ? 0 : length] = 0;
    text[strcspn(text, "\n")] = 0;
    return length >= 0;
}

static int is_there(int card)
{
    char name[80], control[80];
    return read_of(card, "name", name, sizeof name) &&
           !(read_of(card, "control", control, sizeof control) && !strncmp(control, "gone", 4));
}

int snd_card_next(int *card)
{
    for (int k = *card + 1; k < 8; k++)
        if (is_there(k)) {
            *card = k;
            return 0;
        }
    *card = -1;
    return 0;
}

int snd_ctl_open(snd_ctl_t **ctl, const char *name, int mode)
{
    int card = -1;
    (void)mode;
    if (sscanf(name, "hw:%d", &card) != 1 || !is_there(card))
        return -ENODEV;
    *ctl = (snd_ctl_t *)(long)(card + 1);
    return 0;
}

int snd_ctl_close(snd_ctl_t *ctl)
{
    (void)ctl;
    return 0;
}

int snd_ctl_card_info(snd_ctl_t *ctl, snd_ctl_card_info_t *info)
{
    (void)info;
    return read_of((int)(long)ctl - 1, "name", card_name, sizeof card_name) ? 0 : -ENODEV;
}

const char *snd_ctl_card_info_get_name(const snd_ctl_card_info_t *info)
{
    (void)info;
    return card_name;
}

int snd_ctl_pcm_next_device(snd_ctl_t *ctl, int *device)
{
    (void)ctl;
    *device = *device < 0 ? 0 : -1;
    return 0;
}

int snd_ctl_pcm_info(snd_ctl_t *ctl, snd_pcm_info_t *info)
{
    (void)ctl;
    return snd_pcm_info_get_stream(info) == SND_PCM_STREAM_CAPTURE ? 0 : -ENOENT;
}

const char *snd_pcm_info_get_name(const snd_pcm_info_t *info)
{
    (void)info;
    return "USB Audio";
}

int snd_pcm_open(snd_pcm_t **pcm, const char *name, snd_pcm_stream_t stream, int mode)
{
    static int (*real)(snd_pcm_t **, const char *, snd_pcm_stream_t, int);
    char own[16];
    int card;
    if (!real)
        real = (int (*)(snd_pcm_t **, const char *, snd_pcm_stream_t, int))dlsym(RTLD_NEXT, "snd_pcm_open");
    if (sscanf(name, "hw:%d", &card) == 1 || sscanf(name, "plughw:%d", &card) == 1) {
        snprintf(own, sizeof own, "card%d", card);
        name = own;
    }
    return real(pcm, name, stream, mode);
}

static int redirected_open(const char *path, int flags, mode_t mode)
{
    const char *folder = getenv("LIVESSL_INTERFACES");
    char own[1000];
    if (folder && (!strncmp(path, "/proc/asound", 12) || !strncmp(path, "/sys/class/sound", 16))) {
        snprintf(own, sizeof own, "%s%s", folder, path);
        path = own;
    }
    return plain_open(path, flags, mode);
}

int open64(const char *path, int flags, ...)
{
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    return redirected_open(path, flags, mode);
}

int open(const char *path, int flags, ...)
{
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    return redirected_open(path, flags, mode);
}
