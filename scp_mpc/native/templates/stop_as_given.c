
static int stopping_input(void *context, const double *x, double *u)
{
    (void)context;
    const double *const in[3] = {x};
    double *const out[3] = {u};
    return call(@name@_stop, in, out);
}
