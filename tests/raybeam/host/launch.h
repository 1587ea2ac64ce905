// Runs a kernel on the CPU, thread by thread. `arguments` points to each argument's value.
#pragma once
#include "shim.h"

template <class... Parameters, std::size_t... I>
static void launch(
    unsigned blocks, void (*kernel)(Parameters...), void** arguments, std::index_sequence<I...>)
{
    blockDim.x = 128;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < blockDim.x; ++threadIdx.x)
            kernel(*static_cast<Parameters*>(arguments[I])...);
}

template <class... Parameters>
static void launch(unsigned blocks, void (*kernel)(Parameters...), void** arguments)
{
    launch(blocks, kernel, arguments, std::index_sequence_for<Parameters...>());
}

#define RUN(kernel)                                                   \
    extern "C" int parameters_##kernel()                              \
    {                                                                 \
        return count_parameters(kernel);                              \
    }                                                                 \
    extern "C" void run_##kernel(unsigned blocks, void** arguments)   \
    {                                                                 \
        launch(blocks, kernel, arguments);                            \
    }

template <class... Parameters>
static int count_parameters(void (*)(Parameters...))
{
    return sizeof...(Parameters);
}
