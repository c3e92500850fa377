/* A virtual audio interface: an ALSA PCM (I/O plug-in) with a crystal of its own, whose samples say where they belong.
 *
 *     pcm.card0 { type livessl folder "/path/to/card0" channels 18 rates "44100 48000 88200 96000" ppm 50 }
 *
 * A sample is a 24-bit word in S32_LE: 19 bits count the interface's samples since it was made, 5 bits are the channel.
 * The count goes on while nobody records, so what was lost can be counted.
 * With a file "sound" in the folder, in S32_LE with the channels interleaved, that is repeated instead.
 *
 * Faults: the first word of the file "control" in the folder, read at every step.
 *     gone      unplugged: every call fails with ENODEV, also the opening
 *     stall     the interface stops delivering; nothing fails
 *     loop      the same, and the library that drives it hangs in its next call until the fault is over
 *     xrun N    one overrun for each new number N
 *     skip N MS one loss of MS milliseconds, which nothing flags, for each new number N
 * Any other word, or no file: no fault. An interface that is opened twice is busy (EBUSY): the file "lock" is locked.
 */
#include <alsa/asoundlib.h>
#include <alsa/pcm_external.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define STEP_NS 2000000 /* The interface looks at its clock so often. */

enum fault { FINE, GONE, STALL, LOOP, XRUN, SKIP };

struct card {
    snd_pcm_ioplug_t plug;
    char folder[400];
    long channels;
    double ppm;
    int timer, lock, running, gone, overrun;
    int64_t made_ns, start_ns; /* of the interface, and of the stream */
    uint64_t origin;           /* the count at the start of the stream */
    uint64_t produced;         /* samples since then */
    int32_t *sound;            /* of the file; NULL for counts */
    uint64_t sound_frames;
    long xruns, skips;         /* numbers of the last faults that were carried out */
};

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static double samples_in(const struct card *card, int64_t ns)
{
    return 1e-9 * (double)ns * card->plug.rate * (1.0 + 1e-6 * card->ppm);
}

static size_t read_file(const struct card *card, const char *name, char *text, size_t size)
{
    char path[450];
    snprintf(path, sizeof path, "%s/%s", card->folder, name);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    ssize_t length = fd < 0 ? -1 : read(fd, text, size - 1);
    if (fd >= 0)
        close(fd);
    text[length < 0 ? 0 : length] = 0;
    return length < 0 ? 0 : (size_t)length;
}

static enum fault fault_of(const struct card *card, long *number, double *ms)
{
    char text[64], word[16] = "";
    *number = 0;
    *ms = 0.0;
    if (!read_file(card, "control", text, sizeof text) || sscanf(text, "%15s %ld %lf", word, number, ms) < 1)
        return FINE;
    return !strcmp(word, "gone")    ? GONE
           : !strcmp(word, "stall") ? STALL
           : !strcmp(word, "loop")  ? LOOP
           : !strcmp(word, "xrun")  ? XRUN
           : !strcmp(word, "skip")  ? SKIP
                                    : FINE;
}

/* Brings the interface up to the present; returns 0, -EPIPE after an overrun, or -ENODEV. */
static int step(struct card *card)
{
    long number;
    double ms;
    enum fault fault = fault_of(card, &number, &ms);
    while (fault == LOOP) {
        usleep(10000);
        fault = fault_of(card, &number, &ms);
    }
    if (fault == GONE || card->gone) {
        card->gone = 1; /* until it is opened again, as with a real one */
        return -ENODEV;
    }
    if (!card->running || fault == STALL)
        return 0;
    if (fault == XRUN && number != card->xruns) {
        card->xruns = number;
        card->overrun = 1;
    }
    if (card->overrun)
        return -EPIPE; /* until the stream is prepared again */
    if (fault == SKIP && number != card->skips) {
        card->skips = number;
        card->start_ns += (int64_t)(1e6 * ms); /* nothing is delivered for so long … */
        card->origin += (uint64_t)samples_in(card, (int64_t)(1e6 * ms)); /* … and the count goes on */
    }
    int64_t elapsed = now_ns() - card->start_ns;
    uint64_t produced = elapsed > 0 ? (uint64_t)samples_in(card, elapsed) : 0;
    if (produced > card->produced)
        card->produced = produced;
    return card->produced - card->plug.appl_ptr > card->plug.buffer_size ? -EPIPE : 0;
}

static int on_start(snd_pcm_ioplug_t *plug)
{
    struct card *card = plug->private_data;
    struct itimerspec every = {{0, STEP_NS}, {0, STEP_NS}};
    card->start_ns = now_ns();
    card->origin = (uint64_t)samples_in(card, card->start_ns - card->made_ns);
    card->produced = 0;
    card->running = 1;
    timerfd_settime(card->timer, 0, &every, NULL);
    return 0;
}

static int on_stop(snd_pcm_ioplug_t *plug)
{
    struct card *card = plug->private_data;
    struct itimerspec never = {{0, 0}, {0, 0}};
    card->running = 0;
    timerfd_settime(card->timer, 0, &never, NULL);
    return 0;
}

static int on_prepare(snd_pcm_ioplug_t *plug)
{
    struct card *card = plug->private_data;
    card->produced = 0;
    card->running = card->overrun = 0;
    return step(card) == -ENODEV ? -ENODEV : 0;
}

static snd_pcm_sframes_t on_pointer(snd_pcm_ioplug_t *plug)
{
    struct card *card = plug->private_data;
    int error = step(card);
    return error ? error : (snd_pcm_sframes_t)(card->produced % plug->buffer_size);
}

static snd_pcm_sframes_t on_transfer(snd_pcm_ioplug_t *plug, const snd_pcm_channel_area_t *areas,
                                     snd_pcm_uframes_t offset, snd_pcm_uframes_t size)
{
    struct card *card = plug->private_data;
    for (long channel = 0; channel < card->channels; channel++) {
        const snd_pcm_channel_area_t *area = &areas[channel];
        char *at = (char *)area->addr + (area->first + area->step * offset) / 8;
        for (snd_pcm_uframes_t k = 0; k < size; k++, at += area->step / 8) {
            uint64_t count = card->origin + plug->appl_ptr + k;
            uint32_t word = (uint32_t)((count & 0x7FFFF) << 5 | (uint64_t)channel) << 8;
            if (card->sound)
                word = (uint32_t)card->sound[count % card->sound_frames * (uint64_t)card->channels + (uint64_t)channel];
            memcpy(at, &word, sizeof word);
        }
    }
    return (snd_pcm_sframes_t)size;
}

static int on_delay(snd_pcm_ioplug_t *plug, snd_pcm_sframes_t *delay)
{
    struct card *card = plug->private_data;
    int error = step(card);
    *delay = (snd_pcm_sframes_t)(card->produced - plug->appl_ptr);
    return error == -ENODEV ? error : 0;
}

static int on_poll(snd_pcm_ioplug_t *plug, struct pollfd *polled, unsigned count, unsigned short *events)
{
    struct card *card = plug->private_data;
    uint64_t ticks;
    if (count && polled[0].revents & POLLIN && read(card->timer, &ticks, sizeof ticks) < 0)
        ticks = 0;
    int error = step(card);
    if (error == -ENODEV)
        *events = POLLERR | POLLNVAL;
    else if (error)
        *events = POLLIN | POLLERR;
    else
        *events = card->produced - plug->appl_ptr >= plug->period_size ? POLLIN : 0;
    return 0;
}

static int on_close(snd_pcm_ioplug_t *plug)
{
    struct card *card = plug->private_data;
    close(card->timer);
    close(card->lock);
    free(card->sound);
    free(card);
    return 0;
}

static const snd_pcm_ioplug_callback_t callbacks = {
    .start = on_start,
    .stop = on_stop,
    .prepare = on_prepare,
    .pointer = on_pointer,
    .transfer = on_transfer,
    .delay = on_delay,
    .poll_revents = on_poll,
    .close = on_close,
};

/* The time at which the interface was made is kept beside its control file, for all programs that open it. */
static int64_t made_ns(struct card *card)
{
    char text[32], path[450];
    if (!read_file(card, "made", text, sizeof text)) {
        snprintf(text, sizeof text, "%lld", (long long)now_ns());
        snprintf(path, sizeof path, "%s/made", card->folder);
        int fd = open(path, O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
        if (fd < 0 || write(fd, text, strlen(text)) < 0)
            SNDERR("livessl: cannot write %s", path);
        if (fd >= 0)
            close(fd);
    }
    return atoll(text);
}

static void load_sound(struct card *card)
{
    char path[450];
    struct stat about;
    snprintf(path, sizeof path, "%s/sound", card->folder);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return;
    size_t frame = sizeof(int32_t) * (size_t)card->channels;
    if (fstat(fd, &about) == 0 && (size_t)about.st_size >= frame) {
        card->sound = malloc((size_t)about.st_size);
        if (card->sound && read(fd, card->sound, (size_t)about.st_size) == (ssize_t)about.st_size)
            card->sound_frames = (size_t)about.st_size / frame;
        else
            SNDERR("livessl: cannot read %s", path);
    }
    close(fd);
}

static int offer(struct card *card, const char *rates)
{
    static const unsigned accesses[] = {SND_PCM_ACCESS_MMAP_INTERLEAVED, SND_PCM_ACCESS_RW_INTERLEAVED};
    static const unsigned formats[] = {SND_PCM_FORMAT_S32_LE};
    unsigned list[16], listed = 0, frame = 4 * (unsigned)card->channels;
    int length;
    for (; listed < 16 && sscanf(rates, "%u%n", &list[listed], &length) == 1; rates += length)
        listed++;
    snd_pcm_ioplug_t *plug = &card->plug;
    int error = snd_pcm_ioplug_set_param_list(plug, SND_PCM_IOPLUG_HW_ACCESS, 2, accesses);
    if (error >= 0)
        error = snd_pcm_ioplug_set_param_list(plug, SND_PCM_IOPLUG_HW_FORMAT, 1, formats);
    if (error >= 0)
        error = snd_pcm_ioplug_set_param_minmax(plug, SND_PCM_IOPLUG_HW_CHANNELS, card->channels, card->channels);
    if (error >= 0)
        error = snd_pcm_ioplug_set_param_list(plug, SND_PCM_IOPLUG_HW_RATE, listed, list);
    if (error >= 0)
        error = snd_pcm_ioplug_set_param_minmax(plug, SND_PCM_IOPLUG_HW_PERIOD_BYTES, 32 * frame, 8192 * frame);
    if (error >= 0)
        error = snd_pcm_ioplug_set_param_minmax(plug, SND_PCM_IOPLUG_HW_BUFFER_BYTES, 64 * frame, 65536 * frame);
    return error;
}

SND_PCM_PLUGIN_DEFINE_FUNC(livessl)
{
    snd_config_iterator_t i, next;
    const char *folder = NULL, *rates = "44100 48000 88200 96000";
    long channels = 18, whole;
    double ppm = 0.0;
    (void)root;
    snd_config_for_each(i, next, conf)
    {
        snd_config_t *entry = snd_config_iterator_entry(i);
        const char *id;
        if (snd_config_get_id(entry, &id) < 0)
            continue;
        if (!strcmp(id, "folder"))
            snd_config_get_string(entry, &folder);
        else if (!strcmp(id, "rates"))
            snd_config_get_string(entry, &rates);
        else if (!strcmp(id, "channels"))
            snd_config_get_integer(entry, &channels);
        else if (!strcmp(id, "ppm") && snd_config_get_real(entry, &ppm) < 0 && snd_config_get_integer(entry, &whole) >= 0)
            ppm = (double)whole;
    }
    if (!folder || channels < 1 || channels > 32)
        return -EINVAL;
    if (stream != SND_PCM_STREAM_CAPTURE)
        return -ENOENT;

    struct card *card = calloc(1, sizeof *card);
    if (!card)
        return -ENOMEM;
    snprintf(card->folder, sizeof card->folder, "%s", folder);
    card->channels = channels;
    card->ppm = ppm;
    long number;
    double ms;
    char path[450];
    snprintf(path, sizeof path, "%s/lock", folder);
    int error = 0;
    enum fault fault = fault_of(card, &number, &ms);
    if (fault == GONE) {
        free(card);
        return -ENODEV;
    }
    card->xruns = fault == XRUN ? number : 0;
    card->skips = fault == SKIP ? number : 0;
    card->lock = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    card->timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    if (card->lock < 0 || card->timer < 0 || flock(card->lock, LOCK_EX | LOCK_NB) < 0)
        error = -EBUSY;
    if (!error) {
        card->made_ns = made_ns(card);
        load_sound(card);
        card->plug.version = SND_PCM_IOPLUG_VERSION;
        card->plug.name = "livessl's virtual audio interface";
        card->plug.poll_fd = card->timer;
        card->plug.poll_events = POLLIN;
        card->plug.callback = &callbacks;
        card->plug.private_data = card;
        error = snd_pcm_ioplug_create(&card->plug, name, stream, mode);
    }
    if (error < 0) {
        close(card->lock);
        close(card->timer);
        free(card->sound);
        free(card);
        return error;
    }
    error = offer(card, rates);
    if (error < 0) {
        snd_pcm_ioplug_delete(&card->plug);
        return error;
    }
    *pcmp = card->plug.pcm;
    return 0;
}

SND_PCM_PLUGIN_SYMBOL(livessl);
