// The events of the exchange through the thesis's client.
#pragma once

#include <cstdint>
#include <string>
#include <type_traits>

#include "exchange.hpp"
#include "thesis_client.hpp"

namespace thesis {

struct Nothing {};

// Its own type of event for each payload, so that a small ping is no larger than it needs to be.
template <typename Payload>
class Ping final : public Event {
  public:
    static constexpr EventType kType = std::is_same_v<Payload, Nothing> ? EventType::kPing
                                       : std::is_same_v<Payload, exchange::Pixels>
                                           ? EventType::kImagePing
                                           : EventType::kSharedImagePing;

    Ping(std::uint32_t sender, std::uint32_t receiver, std::uint64_t number, std::int64_t stamp,
         const Payload& payload)
        : sender(sender), receiver(receiver), number(number), stamp(stamp), payload(payload) {}

    EventType GetType() const override { return kType; }
    unsigned GetCategories() const override { return kMessageCategory; }
    std::string ToString() const override { return "Ping " + std::to_string(number); }

    std::uint32_t sender;
    std::uint32_t receiver;
    std::uint64_t number;
    std::int64_t stamp;
    Payload payload;
};

class Pong final : public Event {
  public:
    static constexpr EventType kType = EventType::kPong;

    Pong(std::uint32_t sender, std::uint32_t receiver, std::uint64_t number, std::int64_t stamp)
        : sender(sender), receiver(receiver), number(number), stamp(stamp) {}

    EventType GetType() const override { return kType; }
    unsigned GetCategories() const override { return kMessageCategory; }
    std::string ToString() const override { return "Pong " + std::to_string(number); }

    std::uint32_t sender;
    std::uint32_t receiver;
    std::uint64_t number;
    std::int64_t stamp;
};

}  // namespace thesis
