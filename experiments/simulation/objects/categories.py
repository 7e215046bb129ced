"""Coarse categories of models, from the words that catalogues use for them."""

import re

_WORDS = {
    "wall_plate": "plug socket switch",
    "opening": "curtain elevator-door garage-door screen-door shower-door"
    " window-blind window-shutter",
    "plant": "acacia bamboo beech bonsai bush cactus coconut cypress ficus flower-box"
    " flowers hedge lily maple orchids palm peach-blossom pine plant poplar"
    " spathiphyllum tree tulips yucca",
    "toy": "biplane car-model chessboard child-hut children-s-game dart-game doll"
    " doll-house flipper game puzzle rocking-horse rubik-s-cube sandpit seesaw"
    " snowman swing teddy-bear toy toy-train",
    "person": "boy female girl male",
    "animal": "bulldog cat chicken deer dog horse rabbit",
    "food": "apples birthday-cake bowl-with bread butter cup-cake french-fries"
    " hamburger hot-dog roasted-chicken steak",
    "kitchenware": "ashtray beer-glass bowl chopping-board cocktail-glass coffee-cup"
    " coffee-mug coffee-press creamer cup espresso-kettle fork glass"
    " glasses-and-cutlery hashtray kitchen-knife kitchen-tools knife knife-stand"
    " oil-servers pan plate pottery salt-shaker spice-tower spoon squeezer sugar"
    " sushi-tray teapot tool towel-holder tray utensils-pot",
    "sofa": "couch sofa",
    "chair": "armchair bench chair class-seat little-bank lounge puff seat stool"
    " wheelchair wood-bank",
    "lamp": "candle flashlight fluorescent lamp lamppost lantern light lights"
    " spotlight",
    "sport": "abdominal-bench ball basketball fitness-tower football football-table"
    " indoor-bike pool-table punching-ball racket skateboard soccer-ball table-tennis"
    " trampoline treadmill",
    "bed": "bed crib futon hammock mattress sleeping-bag",
    "cabinet": "bedside-table bookcase cabinet chest cupboard dresser filing-cabinet"
    " island living-room locker safe shelves tv-stand vanity wardrobe workbench",
    "table": "desk glass-table table",
    "appliance": "air-conditioning blender boiler chest-freezer coffee-brewer"
    " coffee-machine coffee-maker cooker cooktop deep-fryer dryer fan fridge grill"
    " hood microwave mixer oven refrigerator sandwich-maker scale stove table-fan"
    " toaster washing-machine water-cooler water-heater",
    "heating": "chimney fireplace furnace radiator",
    "sanitary": "basin bath bathtub bidet faucet island-bath jacuzzi lavatory potty"
    " shower sink toilet-brush toilets-unit urinal washbasin",
    "vehicle": "bicycle bike bus chevrolet ford-focus fork-lift motorbike peugeot"
    " renault rowboat scooter seat-leon sedan smart-car stroller suv tricycle truck"
    " van vw wheelbarrow yamaha",
    "electronics": "amplifier apple bell-ring camera cctv dvd-player headphones imac"
    " intercom joystick laptop mp3 phone playstation printer projector radio"
    " remote-control screen smoke-detector speaker speech-unit stereo tablet"
    " thermometer tv",
    "instrument": "guitar keyboard piano xylophone",
    "container": "backpack barrel basket bin bottle box bread-box briefcase container"
    " crate dustbin flacon gift handbag jar letter-tray mailbox milk old-jar pallet"
    " penbox plant-box pot suitcase trash-can trashcan trunck vase",
    "clothing": "bootie cap clothes clothes-basket dress glasses glove hat helmet"
    " jacket mocassin ring shoes short skirt slippers sneakers suit sunglasses towel"
    " towel-rack trousers umbrella watch",
    "tool": "broom brush cone cutting-pliers drill extinguisher grinder hammer"
    " hose-reel mower saw scissors screwdriver shovel stapler step-ladder tape",
    "structure": "barnum column diving-board dog-house escalator fence fire-hydrant"
    " fountain garden-hut rail-crossing railing round-chimney sidewalk staircase"
    " swimming-pool tent",
}
NO_OBJECTS = {
    "wall_plate": "is a wall plate",
    "opening": "belongs to a door or a window",
}
"""What is left out, and how it is told."""
OTHER = "other"
CATEGORIES = (*(name for name in _WORDS if name not in NO_OBJECTS), OTHER)


def category_of(title: str) -> str:
    """One of `CATEGORIES` or of `NO_OBJECTS` by a model's English title.

    Of all words and phrases of the table that the title holds, the longest decides, and
    of two that are as long the first. Where there is none, it is `OTHER`.
    """
    told = f"-{re.sub('[^a-z0-9]+', '-', title.lower())}-"
    found = [
        (len(word), category)
        for category, words in _WORDS.items()
        for word in words.split()
        if f"-{word}-" in told
    ]
    return max(found, key=lambda pair: pair[0])[1] if found else OTHER
